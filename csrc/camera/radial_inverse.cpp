#include "camera/radial_inverse.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace edgegrad {

RadialInverse::RadialInverse(const AnyLens& lens, double fold, double farthest) {
    constexpr double nan = std::numeric_limits<double>::quiet_NaN(), tolerance = 1e-13;
    const double reach = with_radial_lens(lens, [&](const auto& l) { return l.radius(fold); });
    const double most = std::min(farthest, reach);
    cells_per_square_ = cells / (most * most);
    const auto place = [&](int cell, double t) { return std::sqrt((cell + 0.5 * (t + 1)) / cells_per_square_); };
    const auto h = [&](double m) { return undistorted_radius(lens, fold, m) / m; };
    std::array<double, terms> node;
    for (int j = 0; j < terms; ++j) node[j] = std::cos(M_PI * (j + 0.5) / terms);  // Chebyshev's nodes
    rows_.back().fill(nan);
    for (int cell = 0; cell < cells; ++cell) {
        auto& row = rows_[cell];
        if (!(place(cell, 1) < reach)) {
            row.fill(nan);
            continue;
        }
        // Newton's divided differences are converted to powers of t.
        for (int j = 0; j < terms; ++j) row[j] = h(place(cell, node[j]));
        for (int order = 1; order < terms; ++order)
            for (int j = terms - 1; j >= order; --j) row[j] = (row[j] - row[j - 1]) / (node[j] - node[j - order]);
        for (int i = terms - 2; i >= 0; --i)
            for (int j = i; j < terms - 1; ++j) row[j] -= node[i] * row[j + 1];
        // The interpolation error is greatest at the ends of a cell. At the axis h is 0 / 0.
        for (const double t : {cell ? -1.0 : -0.999, 1.0}) {
            double value = 0;
            for (int j = terms - 1; j >= 0; --j) value = row[j] + t * value;
            const double right = h(place(cell, t));
            if (!(std::fabs(value - right) <= tolerance * right)) row.fill(nan);
        }
    }
}

EDGEGRAD_VECTORIZED bool RadialInverse::undistort(int k, double* x, double* y) const {
    const double scale = cells_per_square_;
    const auto* rows = rows_.data();
    int64_t outside = 0;
    for (int i = 0; i < k; ++i) {
        const double place = scale * (x[i] * x[i] + y[i] * y[i]);
        const int cell = int(place < cells ? place : cells);
        const double t = 2 * (place - cell) - 1, *row = rows[cell].data();
        double h = row[terms - 1];
        for (int j = terms - 2; j >= 0; --j) h = row[j] + t * h;
        x[i] *= h, y[i] *= h;
        outside |= int64_t(!(h > 0));
    }
    return !outside;
}

}  // namespace edgegrad
