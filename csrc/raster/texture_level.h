// Computes texture positions from coordinates, and pyramid levels from their image derivatives, each with its _vjp.
#pragma once

#include <cmath>
#include <numbers>

#include "core/math.h"
#include "raster/texels.h"

namespace edgegrad {

// Holds the coordinates of one pixel and their derivatives in the image: (u, v), or the direction (x, y, z) for a cube.
// ∂/∂X and ∂/∂Y of each alternate.
struct TextureCoordinates {
    double at[3] = {}, by_pixel[6] = {};
};

// Returns false where a cube has no such direction.
inline bool place_of(const TextureCoordinates& uv, BoundaryMode boundary_mode, TexturePlace& out) {
    if (boundary_mode != BoundaryMode::cube) {
        out = {0, uv.at[0], uv.at[1]};
        return true;
    }
    const int side = side_of(uv.at);
    if (side < 0) return false;
    const SideAxes& axes = side_axes[side];
    const double m = std::fabs(uv.at[axes.major]);
    out = {side, 0.5 * (axes.s_sign * uv.at[axes.s] / m + 1), 0.5 * (axes.t_sign * uv.at[axes.t] / m + 1)};
    return true;
}
inline void place_vjp(const TextureCoordinates& uv, BoundaryMode boundary_mode, const TexturePlace& place, Vec2 bar,
                      TextureCoordinates& uv_bar) {
    if (boundary_mode != BoundaryMode::cube) {
        uv_bar.at[0] += bar.x, uv_bar.at[1] += bar.y;
        return;
    }
    const SideAxes& axes = side_axes[place.side];
    const double m = std::fabs(uv.at[axes.major]), s = 2 * place.s - 1, t = 2 * place.t - 1;
    uv_bar.at[axes.s] += 0.5 * bar.x * axes.s_sign / m, uv_bar.at[axes.t] += 0.5 * bar.y * axes.t_sign / m;
    uv_bar.at[axes.major] -= 0.5 * axes.sign * (bar.x * s + bar.y * t) / m;
}

// Returns how (s, t) in texels change for a pixel to the right (X) and up (Y): rows of s and of t.
inline Mat2 texels_a_pixel(const TextureCoordinates& uv, const TextureShape& t, const TexturePlace& place) {
    const double w = double(t.width), h = double(t.height), *d = uv.by_pixel;
    if (t.boundary_mode != BoundaryMode::cube) return {w * d[0], w * d[1], h * d[2], h * d[3]};
    // s = (±x_s / m + 1) / 2 gives ∂s = (±∂x_s − (2 s − 1) ∂m) / (2 m).
    const SideAxes& axes = side_axes[place.side];
    const double scale = 0.5 * w / std::fabs(uv.at[axes.major]), s = 2 * place.s - 1, r = 2 * place.t - 1;
    const auto of = [&](int axis, int k) { return d[2 * axis + k]; };
    const auto m = [&](int k) { return axes.sign * of(axes.major, k); };
    return {scale * (axes.s_sign * of(axes.s, 0) - s * m(0)), scale * (axes.s_sign * of(axes.s, 1) - s * m(1)),
            scale * (axes.t_sign * of(axes.t, 0) - r * m(0)), scale * (axes.t_sign * of(axes.t, 1) - r * m(1))};
}
inline void texels_a_pixel_vjp(const TextureCoordinates& uv, const TextureShape& t, const TexturePlace& place,
                               const Mat2& bar, TextureCoordinates& uv_bar) {
    const double w = double(t.width), h = double(t.height);
    double* d = uv_bar.by_pixel;
    if (t.boundary_mode != BoundaryMode::cube) {
        d[0] += w * bar.xx, d[1] += w * bar.xy, d[2] += h * bar.yx, d[3] += h * bar.yy;
        return;
    }
    const SideAxes& axes = side_axes[place.side];
    const double size = std::fabs(uv.at[axes.major]), scale = 0.5 * w / size, s = 2 * place.s - 1, r = 2 * place.t - 1;
    const double s_bar[2] = {scale * bar.xx, scale * bar.xy}, t_bar[2] = {scale * bar.yx, scale * bar.yy};
    double by_s = 0, by_t = 0;  // cotangents of 2 s − 1 and 2 t − 1
    for (int k = 0; k < 2; ++k) {
        const double m = axes.sign * uv.by_pixel[2 * axes.major + k];
        d[2 * axes.s + k] += axes.s_sign * s_bar[k], d[2 * axes.t + k] += axes.t_sign * t_bar[k];
        d[2 * axes.major + k] -= axes.sign * (s * s_bar[k] + r * t_bar[k]);
        by_s -= m * s_bar[k], by_t -= m * t_bar[k];
    }
    place_vjp(uv, t.boundary_mode, place, {2 * by_s, 2 * by_t}, uv_bar);
    // This adds the cotangent of 1 / m.
    const Mat2 jacobian = texels_a_pixel(uv, t, place);
    const double along = jacobian.xx * bar.xx + jacobian.xy * bar.xy + jacobian.yx * bar.yx + jacobian.yy * bar.yy;
    uv_bar.at[axes.major] -= axes.sign * along / size;
}

// Computes log2 of the longer axis of the ellipse of texels that a pixel's circle maps to. It is half that of the
// larger eigenvalue of JᵀJ, or −∞ where J is zero.
struct LongAxis {
    double level;
    Vec2 direction;  // unit eigenvector
    double square;   // eigenvalue

    explicit LongAxis(const Mat2& j) {
        const double a = j.xx * j.xx + j.yx * j.yx, b = j.xx * j.xy + j.yx * j.yy, c = j.xy * j.xy + j.yy * j.yy;
        const double half = 0.5 * (a - c), root = std::sqrt(half * half + b * b);
        square = 0.5 * (a + c) + root;
        level = 0.5 * std::log2(square);
        const Vec2 v = half >= 0 ? Vec2{half + root, b} : Vec2{b, root - half};
        const double size = length(v);
        direction = size > 0 ? 1 / size * v : Vec2{1, 0};
    }
};
// Uses δ square = 2 (J v) · (δJ v).
inline Mat2 long_axis_vjp(const Mat2& j, const LongAxis& axis, double level_bar) {
    const double scale = level_bar / (std::numbers::ln2 * axis.square);
    const Vec2 v = axis.direction, jv = scale * (j * v);
    return {jv.x * v.x, jv.x * v.y, jv.y * v.x, jv.y * v.y};
}

}  // namespace edgegrad
