#include "interior/face_lanes.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

constexpr int lanes = FaceLanes::size;

// Returns the greatest whole number up to x, within 0 … most; 0 for NaN.
inline int32_t whole(double x, double most) { return int32_t(std::min(std::max(0.0, x), most)); }

EDGEGRAD_VECTORIZED void bound_lanes(FaceLanes& f, int width, int height, double radius) {
    const double w = width, h = height;
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const double ax = f.x[1][i] - f.x[0][i], ay = f.y[1][i] - f.y[0][i];
        const double bx = f.x[2][i] - f.x[0][i], by = f.y[2][i] - f.y[0][i];
        const double cx = f.x[2][i] - f.x[1][i], cy = f.y[2][i] - f.y[1][i];
        f.wedge[i] = ax * by - ay * bx;
        f.longest[i] = std::sqrt(std::max(std::max(ax * ax + ay * ay, bx * bx + by * by), cx * cx + cy * cy));
    }
    const auto low = [](const double (&a)[3][lanes], int i) { return std::min(std::min(a[0][i], a[1][i]), a[2][i]); };
    const auto high = [](const double (&a)[3][lanes], int i) { return std::max(std::max(a[0][i], a[1][i]), a[2][i]); };
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) f.depths[i] = high(f.z, i) / low(f.z, i);
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i)
        f.i0[i] = whole(low(f.x, i) - radius, w), f.i1[i] = whole(high(f.x, i) + radius + 1, w);
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i)
        f.j0[i] = whole(low(f.y, i) - radius, h), f.j1[i] = whole(high(f.y, i) + radius + 1, h);
    for (int axis = 0; axis < 2; ++axis) {
        const auto& a = axis ? f.y : f.x;
        const double most = (axis ? h : w) - 1;
        int32_t (&to)[4][lanes] = f.inside[axis];
        EDGEGRAD_ROLLED
        for (int i = 0; i < lanes; ++i) {
            to[0][i] = whole(0.5 * (a[0][i] + a[1][i]), most), to[1][i] = whole(0.5 * (a[1][i] + a[2][i]), most);
            to[2][i] = whole(0.5 * (a[2][i] + a[0][i]), most);
            to[3][i] = whole((1.0 / 3) * (a[0][i] + a[1][i] + a[2][i]), most);
        }
    }
}

EDGEGRAD_VECTORIZED void bound_hidden(HiddenFaces& f, int width, int height, int columns, double rounding) {
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i)
        f.wedge[i] =
            (f.x[1][i] - f.x[0][i]) * (f.y[2][i] - f.y[0][i]) - (f.y[1][i] - f.y[0][i]) * (f.x[2][i] - f.x[0][i]);
    const auto extent = [](double a, double b, double c) {
        return std::max(std::max(a, b), c) - std::min(std::min(a, b), c);
    };
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i)
        f.side[i] = std::max(extent(f.x[0][i], f.x[1][i], f.x[2][i]), extent(f.y[0][i], f.y[1][i], f.y[2][i]));
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const double least = rounding * f.side[i];
        f.extent[i] = 0.5 * std::fabs(f.wedge[i]) + f.side[i];
        f.facing[i] = int32_t(f.wedge[i] > least) - int32_t(f.wedge[i] < -least);
    }
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i)
        f.tile[i] = whole(f.y[0][i], height - 1) / OcclusionHint::tile * columns +
                    whole(f.x[0][i], width - 1) / OcclusionHint::tile;
}

// Adds the contribution of one channel.
EDGEGRAD_VECTORIZED void integrate_channel(FaceLanes& f, const double* __restrict A, const double* __restrict color,
                                           double* __restrict T) {
    const double *A0 = A, *A1 = A + lanes, *A2 = A + 2 * lanes, *inside = A + 3 * lanes;
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const double all = A0[i] + A1[i] + A2[i];
        T[i] = (1.0 / 12) * (A0[i] + all);
        T[lanes + i] = (1.0 / 12) * (A1[i] + all);
        T[2 * lanes + i] = (1.0 / 12) * (A2[i] + all);
    }
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const double mean = (1.0 / 3) * (A0[i] + A1[i] + A2[i]);
        const auto apart = [&](int k) { return std::fabs(inside[k * lanes + i] - mean); };
        f.sum[i] += std::fabs(A0[i]) + std::fabs(A1[i]) + std::fabs(A2[i]);
        f.change[i] += std::fabs(A1[i] - A0[i]) + std::fabs(A2[i] - A0[i]);
        f.apart[i] += apart(0) + apart(1) + apart(2) + apart(3);
    }
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        // This is ∇L times the area, as in Control::add_to_places.
        const double half = f.wedge[i] < 0 ? -0.5 : 0.5, d1 = half * color[i], d2 = half * color[lanes + i];
        const double x = d1 * (f.y[2][i] - f.y[0][i]) - d2 * (f.y[1][i] - f.y[0][i]);
        const double y = d2 * (f.x[1][i] - f.x[0][i]) - d1 * (f.x[2][i] - f.x[0][i]);
        f.x_bar[0][i] -= T[i] * x, f.y_bar[0][i] -= T[i] * y;
        f.x_bar[1][i] -= T[lanes + i] * x, f.y_bar[1][i] -= T[lanes + i] * y;
        f.x_bar[2][i] -= T[2 * lanes + i] * x, f.y_bar[2][i] -= T[2 * lanes + i] * y;
    }
}

}  // namespace

void FaceLanes::bound(int width, int height, double radius) { bound_lanes(*this, width, height, radius); }

void HiddenFaces::bound(const OcclusionHint& occlusion, double rounding) {
    bound_hidden(*this, occlusion.width(), occlusion.height(), occlusion.columns(), rounding);
}

void FaceLanes::integrate() {
    for (double* a : {sum, change, apart}) std::fill(a, a + size, 0.0);
    for (int k = 0; k < 3; ++k) std::fill(x_bar[k], x_bar[k] + size, 0.0), std::fill(y_bar[k], y_bar[k] + size, 0.0);
    for (int c = 0; c < C; ++c)
        integrate_channel(*this, &adjoint[7 * c * size], &color[2 * c * size], &T[3 * c * size]);
}

}  // namespace edgegrad
