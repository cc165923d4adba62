// What the image says of occlusion: a curve or a face that lies behind everything that was hit in the pixels it touches
// is most likely occluded. It gets fewer samples, never none, so that nothing is biased.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <vector>

#include "math.h"
#include "parallel.h"

namespace edgegrad {

// Maxima over squares of 1, 2, 4, … pixels of the farthest depth that the image hit, infinite where a sample hit
// nothing: any box is covered by four squares of one level (cf. the hierarchical z-buffer of Greene et al. 1993).
class OcclusionHint {
   public:
    // `depth` (H, W), see ForwardOutput; null: nothing is known.
    OcclusionHint(const float* depth, int width, int height, Team& team) {
        if (!depth) return;
        levels_.push_back({depth, width, height});
        while (levels_.back().width > 1 || levels_.back().height > 1) {
            const Level below = levels_.back();
            const int w = (below.width + 1) / 2, h = (below.height + 1) / 2;
            storage_.emplace_back(size_t(w) * h);
            float* out = storage_.back().data();
            const int rows = std::max(1, (1 << 14) / w);
            team.each((h + rows - 1) / rows, [&](int64_t k) {
                for (int j = int(k) * rows; j < std::min(h, (int(k) + 1) * rows); ++j) {
                    const float* a = below.depth + size_t(2 * j) * below.width;
                    const float* b = 2 * j + 1 < below.height ? a + below.width : a;
                    float* row = out + size_t(j) * w;
                    const int pairs = below.width / 2;
                    for (int i = 0; i < pairs; ++i)
                        row[i] = std::max(std::max(a[2 * i], a[2 * i + 1]), std::max(b[2 * i], b[2 * i + 1]));
                    if (pairs < w) row[pairs] = std::max(a[2 * pairs], b[2 * pairs]);
                }
            });
            levels_.push_back({out, w, h});
        }
    }

    // Whether what lies in this box of the image, no nearer than `nearest`, is behind all that was hit there and one
    // pixel around it: where a surface is steep, the samples of one pixel miss its farthest part.
    bool hides(Vec2 low, Vec2 high, double nearest) const {
        if (levels_.empty()) return false;
        const Level& image = levels_[0];
        const int i0 = pixel(low.x - 1, image.width), i1 = pixel(high.x + 1, image.width);
        const int j0 = pixel(low.y - 1, image.height), j1 = pixel(high.y + 1, image.height);
        // A box no wider than a square of the level touches two of them at most.
        const int k = std::bit_width(unsigned(std::max(i1 - i0, j1 - j0)));
        const Level& level = levels_[std::min<size_t>(k, levels_.size() - 1)];
        const auto at = [&](int i, int j) { return level.depth[size_t(j >> k) * level.width + (i >> k)]; };
        return nearest > std::max(std::max(at(i0, j0), at(i1, j0)), std::max(at(i0, j1), at(i1, j1)));
    }

   private:
    struct Level {
        const float* depth;
        int width, height;
    };
    static int pixel(double x, int count) { return int(std::clamp(std::floor(x), 0.0, double(count - 1))); }

    std::vector<std::vector<float>> storage_;
    std::vector<Level> levels_;
};

}  // namespace edgegrad
