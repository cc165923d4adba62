// Which place of the undistorted image a radial lens shows, by a table.
#pragma once

#include <array>

#include "camera/lens.h"

namespace edgegrad {

// A radial lens shows n = h(|m|²) m at the place m. Polynomials of |m|² interpolate h in equal cells, to the last
// digits of doubles. The table depends on the coefficients and on how far the image reaches, and takes 8 KiB.
class RadialInverse {
   public:
    // It covers |m| ≤ farthest, as far as the disc reaches.
    RadialInverse(const AnyLens& lens, double fold, double farthest);

    // Replaces k places m by n. False: some lie outside the table, or near the fold, where h is no polynomial.
    bool undistort(int k, double* x, double* y) const;

   private:
    static constexpr int cells = 128, terms = 8;

    double cells_per_square_;
    // The coefficients of each cell, by powers of t, which runs from −1 to 1. The last row holds NaN.
    std::array<std::array<double, terms>, cells + 1> rows_;
};

}  // namespace edgegrad
