// This file selects the pixels whose samples replace those of large triangles, and of textured ones under lights.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <vector>

#include "camera/camera.h"
#include "core/math.h"

namespace edgegrad {

// PixelMask holds the pixels that large triangles may touch, by tiles.
class PixelMask {
   public:
    // Covers the image and `beyond` pixels beyond each of its sides.
    PixelMask(const Camera& camera, double radius, int beyond)
        : width_(camera.width + 2 * beyond),
          height_(camera.height + 2 * beyond),
          radius_(radius),
          beyond_(beyond),
          columns_((width_ + tile - 1) / tile),
          marked_(size_t(columns_) * ((height_ + tile - 1) / tile), 0) {}

    // Marks a box in the image.
    void mark(Vec2 low, Vec2 high) {
        low += Vec2{double(beyond_), double(beyond_)}, high += Vec2{double(beyond_), double(beyond_)};
        const auto index = [](double x, int most) {
            return int(std::clamp(std::floor(x), 0.0, double(most - 1))) / tile;
        };
        const int i0 = index(low.x - radius_, width_), i1 = index(high.x + radius_, width_);
        const int j0 = index(low.y - radius_, height_), j1 = index(high.y + radius_, height_);
        for (int j = j0; j <= j1; ++j)
            for (int i = i0; i <= i1; ++i)
                std::atomic_ref(marked_[size_t(j) * columns_ + i]).store(1, std::memory_order_relaxed);
    }

    // Returns the pixels square by square, because nearby rays are cast faster together.
    std::vector<int64_t> pixels() const {
        std::vector<int64_t> out;
        for (size_t t = 0; t < marked_.size(); ++t) {
            if (!marked_[t]) continue;
            const int left = int(t) % columns_ * tile, top = int(t) / columns_ * tile;
            for (int k = 0; k < tile * tile; ++k) {
                const int square = k / (square_size * square_size), i = k % (square_size * square_size);
                const int x = left + square % (tile / square_size) * square_size + i % square_size;
                const int y = top + square / (tile / square_size) * square_size + i / square_size;
                if (x < width_ && y < height_) out.push_back(int64_t(y) * width_ + x);
            }
        }
        return out;
    }

   private:
    static constexpr int tile = 16, square_size = 4;  // px
    int width_, height_;
    double radius_;
    int beyond_, columns_;
    std::vector<uint8_t> marked_;
};

// Keeps the fraction `share` of the pixels, evenly spread, each with the same probability.
inline void thin_out(std::vector<int64_t>& pixels, double share, double offset) {
    if (share >= 1) return;
    size_t kept = 0;
    for (size_t i = 0; i < pixels.size(); ++i)
        if (std::floor(double(i + 1) * share + offset) > std::floor(double(i) * share + offset))
            pixels[kept++] = pixels[i];
    pixels.resize(kept);
}

}  // namespace edgegrad
