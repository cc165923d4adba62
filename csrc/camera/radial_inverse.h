// Tabulates the inverse of a radial lens.
#pragma once

#include <array>

#include "camera/lens.h"

namespace edgegrad {

// A radial lens shows n = h(|m|²) m at the position m. Polynomials of |m|² interpolate h in equal cells, to double
// precision. The table depends on the coefficients and on the reach of the image, and takes 8 KiB.
class RadialInverse {
   public:
    // Covers |m| ≤ farthest, as far as the disc reaches.
    RadialInverse(const AnyLens& lens, double fold, double farthest);

    // Replaces k positions m by n. Returns false if some lie outside the table, or near the fold, where h is not
    // smooth.
    bool undistort(int k, double* x, double* y) const;

   private:
    static constexpr int cells = 128, terms = 8;

    double cells_per_square_;
    // Each cell has coefficients of powers of t, which runs from −1 to 1. The last row holds NaN.
    std::array<std::array<double, terms>, cells + 1> rows_;
};

}  // namespace edgegrad
