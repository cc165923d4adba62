// Sierpiński's space-filling curve through a triangle: equal steps along it cover equal areas, and what is near on it
// is near in the triangle. Equally spaced points on it, each moved at random within its cell, have an error that falls
// as 1/n where the integrand is smooth (He and Owen 2016, "Extensible grids: uniform sampling on a space filling
// curve"), and consecutive rays, texels and adjoints lie side by side.
#pragma once

#include <bit>
#include <cstdint>

#include "core/math.h"

namespace edgegrad {

class SierpinskiCurve {
   public:
    static constexpr int most_levels = 30;

    // The curve runs from p to r; q is the apex. It is cut into 2^levels cells of the same area.
    void set(Vec2 p, Vec2 q, Vec2 r, int levels) {
        triangle_[0] = {p, q, r};
        levels_ = levels, known_ = false;
    }

    // The point u of the unit square, mapped uniformly to cell k.
    Vec2 point(uint32_t k, Vec2 u) {
        // The halves above the highest bit that changed are those of the last cell: two steps on average.
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
