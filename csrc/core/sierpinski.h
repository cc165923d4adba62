// Implements Sierpiński's space-filling curve through a triangle. Equal steps along it cover equal areas, and close
// points on it are close in the triangle. The error of equally spaced points, jittered within their cells, falls as 1/n
// for smooth integrands (He and Owen 2016, "Extensible grids: uniform sampling on a space filling curve"). Consecutive
// rays, texels and adjoints are also close in memory.
#pragma once

#include <bit>
#include <cstdint>

#include "core/math.h"

namespace edgegrad {

class SierpinskiCurve {
   public:
    static constexpr int most_levels = 30;

    // Sets the curve from p to r with the apex q, cut into 2^levels cells of equal area.
    void set(Vec2 p, Vec2 q, Vec2 r, int levels) {
        triangle_[0] = {p, q, r};
        levels_ = levels, known_ = false;
    }

    // Maps the point u of the unit square uniformly to cell k.
    Vec2 point(uint32_t k, Vec2 u) {
        // The halves above the highest changed bit are those of the last cell, so this takes two steps on average.
        for (int l = known_ ? levels_ - std::bit_width(k ^ cell_) : 0; l < levels_; ++l) {
            const auto& [p, q, r] = triangle_[l];
            const Vec2 middle = 0.5 * (p + r);
            triangle_[l + 1] = k >> (levels_ - 1 - l) & 1 ? Triangle{q, middle, r} : Triangle{p, middle, q};
        }
        cell_ = k, known_ = true;
        const auto& [p, q, r] = triangle_[levels_];
        const double root = std::sqrt(u.x);
        return p + root * (q - p + u.y * (r - q));
    }

   private:
    struct Triangle {
        Vec2 p, q, r;
    };
    Triangle triangle_[most_levels + 1];
    int levels_ = 0;
    uint32_t cell_ = 0;
    bool known_ = false;
};

}  // namespace edgegrad
