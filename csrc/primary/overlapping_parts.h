// This file finds where unconnected parts of the surface (topology.h) overlap or adjoin in the image. One occludes the
// other there, or intersects it, and no curve of either tells.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/math.h"
#include "core/parallel.h"
#include "scene/topology.h"

namespace edgegrad {

class OverlappingParts {
   public:
    // `hit` (H, W, 2) has the first and the last of the faces (F, 3) that were hit in each pixel; see HitBuffers.
    OverlappingParts(const int32_t* hit, const int32_t* faces, const ConnectedParts& parts, int width, int height,
                     ThreadTeam& team)
        : width_(width), height_(height) {
        if (parts.size() < 2) return;
        std::vector<int32_t> part(size_t(width) * height);  // −1: no part, −2: several
        const int rows = std::max(1, (1 << 14) / width), strips = (height + rows - 1) / rows;
        const auto each_row = [&](auto body) {
            team.parallel_for(strips, [&](int64_t k) {
                for (int j = int(k) * rows; j < std::min(height, (int(k) + 1) * rows); ++j) body(j);
            });
        };
        each_row([&](int j) {
            for (int64_t p = int64_t(j) * width; p < int64_t(j + 1) * width; ++p) {
                if (hit[2 * p] < 0) {
                    part[p] = -1;
                    continue;
                }
                const int32_t first = parts.of(faces[3 * int64_t(hit[2 * p])]);
                part[p] = first == parts.of(faces[3 * int64_t(hit[2 * p + 1])]) ? first : -2;
            }
        });
        overlap_.resize(part.size());
        each_row([&](int j) {
            for (int i = 0; i < width; ++i) {
                int32_t one = -1;
                bool several = false;
                for (int y = std::max(j - 1, 0); y <= std::min(j + 1, height - 1); ++y)
                    for (int x = std::max(i - 1, 0); x <= std::min(i + 1, width - 1); ++x) {
                        const int32_t p = part[size_t(y) * width + x];
                        several |= p == -2 || (p >= 0 && one >= 0 && p != one);
                        one = std::max(one, p);
                    }
                overlap_[size_t(j) * width + i] = several;
            }
        });
    }

    // Returns whether parts may overlap in a box of the image, or in a pixel next to it.
    bool in(Vec2 low, Vec2 high) const {
        if (overlap_.empty()) return false;
        const int i0 = pixel(low.x, width_), i1 = pixel(high.x, width_);
        const int j0 = pixel(low.y, height_), j1 = pixel(high.y, height_);
        if (int64_t(i1 - i0 + 1) * (j1 - j0 + 1) > most_pixels) return true;
        for (int j = j0; j <= j1; ++j)
            for (int i = i0; i <= i1; ++i)
                if (overlap_[size_t(j) * width_ + i]) return true;
        return false;
    }

    static constexpr int64_t bytes_per_pixel = sizeof(int32_t) + sizeof(uint8_t);

   private:
    static int pixel(double x, int count) { return int(std::clamp(x, 0.0, double(count - 1))); }
    static constexpr int64_t most_pixels = 64;  // larger boxes are not searched
    int width_, height_;
    std::vector<uint8_t> overlap_;  // (H, W): whether parts overlap in a pixel or next to it; empty: there is one part
};

}  // namespace edgegrad
