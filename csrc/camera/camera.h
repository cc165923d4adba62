// Cameras: point → pixel and back, in camera coordinates q = R p + t; each with its _vjp.
//
// A camera is a projection to normalised image coordinates n (projection.h) and the affine map K of these. World
// coordinates come in only at the ends: vertices are transformed once, and the cotangents of q are turned into those of
// p, R and t once, when all samples are done.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "camera/projection.h"
#include "core/math.h"

namespace edgegrad {

struct Camera {
    Mat3 R;
    Vec3 t;
    double k[6];  // the upper two rows of K: x = k0 n.x + k1 n.y + k2, y = k3 n.x + k4 n.y + k5
    bool perspective;
    int width, height;
    Mat3 R_inverse;
    double k_det;
    double k_inverse[4];     // of the 2 × 2 part of K, row by row
    double pixels_per_unit;  // at most, of normalised image coordinates

    // world_to_camera (4, 4) and K (3, 3), row by row.
    Camera(const double* world_to_camera, const double* K, bool perspective_, int width_, int height_)
        : perspective(perspective_), width(width_), height(height_) {
        for (int i = 0; i < 3; ++i)
            R.row[i] = {world_to_camera[4 * i], world_to_camera[4 * i + 1], world_to_camera[4 * i + 2]};
        // An orthographic view is the same from any distance; from none, depths are rounded least.
        t = {world_to_camera[3], world_to_camera[7], perspective ? world_to_camera[11] : 0.0};
        for (int i = 0; i < 6; ++i) k[i] = K[i];
        R_inverse = inverse(R);
        pixels_per_unit = std::fabs(k[0]) + std::fabs(k[1]) + std::fabs(k[3]) + std::fabs(k[4]);
        k_det = k[0] * k[4] - k[1] * k[3];
        k_inverse[0] = k[4] / k_det, k_inverse[1] = -k[1] / k_det;
        k_inverse[2] = -k[3] / k_det, k_inverse[3] = k[0] / k_det;
    }

    Vec3 to_camera(Vec3 p) const { return R * p + t; }

    // f(Perspective()) or f(Orthographic()).
    template <class F>
    auto projection(F f) const {
        return perspective ? f(Perspective()) : f(Orthographic());
    }

    // Of the projection; see Perspective.
    double depth_weight(Vec3 q) const {
        return projection([&](auto p) { return p.weight(q); });
    }
    Vec3 view_direction(Vec3 q) const {
        return projection([&](auto p) { return p.view_direction(q); });
    }
    Vec3 to_viewer(Vec3 q) const { return -view_direction(q); }
    double unit_at_depth(double z) const {
        return projection([&](auto p) { return p.unit_at_depth(z); });
    }
    double affine_depth_slope(double z) const {
        return projection([&](auto p) { return p.affine_depth_slope(z); });
    }
    Vec2 affine_depth_gradient(Vec3 N, Vec3 q) const {
        return projection([&](auto p) { return p.affine_depth_gradient(N, q); });
    }
    double along_ray(Vec3 N, Vec2 n) const {
        return projection([&](auto p) { return p.along_ray(N, n); });
    }
    bool passes_through_eye(const Vec3 q[3]) const {
        return projection([&](auto p) { return p.passes_through_eye(q); });
    }

    // World units that a pixel spans at a depth, at least.
    double pixel_at_depth(double z) const { return unit_at_depth(z) / pixels_per_unit; }

    // Whether what spans depths in this ratio moves in the image nearly as an affine function of its corners does.
    bool is_nearly_affine(double depths) const { return !perspective || depths < 2; }

    // Orientation of (q0, q1, q2) in the image, x to the right and y down: > 0 where (x1 − x0) ∧ (x2 − x0) > 0.
    // The triple product decides for triangles that reach behind the camera too, and it is one number for the three
    // edges of a face, so that they never disagree. 0: seen edge-on, its plane holds the eye as far as doubles can
    // tell.
    int facing(Vec3 q0, Vec3 q1, Vec3 q2) const {
        const Vec3 view = view_direction(q0), e1 = q1 - q0, e2 = q2 - q0;
        const double s = dot(view, cross(e1, e2));
        if (std::fabs(s) <= rounding_of_triple_product(view, e1, e2)) return 0;
        return s * k_det > 0 ? 1 : -1;
    }

    // Roundings that the denominator w of a point has, relative to itself, if its depth is a sum of terms of this size.
    double roundings_of_weight(double terms, double w) const { return perspective ? terms / w : 1; }

    // Bound of the rounding of pixel positions in or near the image, generous: each is a sum of products with
    // normalised coordinates, which the inverse of K bounds, and of the principal point.
    double rounding_of_positions() const {
        const double most = 2.0 * (width + height) + std::fabs(k[2]) + std::fabs(k[5]);
        double inverse = 0;
        for (const double a : k_inverse) inverse += std::fabs(a);
        return 32 * std::numeric_limits<double>::epsilon() * (1 + pixels_per_unit * inverse) * most;
    }

    // From which side (q0, q1, q2) is seen: 1 or 2. Seen edge-on, either will do for those who ask.
    uint8_t side(Vec3 q0, Vec3 q1, Vec3 q2) const {
        return dot(view_direction(q0), cross(q1 - q0, q2 - q0)) > 0 ? 1 : 2;
    }
};

// Pixel position of q.
inline Vec2 project(const Camera& c, Vec3 q) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    return {c.k[0] * n.x + c.k[1] * n.y + c.k[2], c.k[3] * n.x + c.k[4] * n.y + c.k[5]};
}

inline void project_vjp(const Camera& c, Vec3 q, Vec2 bar, Vec3& q_bar, double k_bar[6]) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    k_bar[0] += bar.x * n.x, k_bar[1] += bar.x * n.y, k_bar[2] += bar.x;
    k_bar[3] += bar.y * n.x, k_bar[4] += bar.y * n.y, k_bar[5] += bar.y;
    const Vec2 n_bar{c.k[0] * bar.x + c.k[3] * bar.y, c.k[1] * bar.x + c.k[4] * bar.y};
    const double w_bar = -(n_bar.x * n.x + n_bar.y * n.y) * w;
    q_bar += Vec3{n_bar.x * w, n_bar.y * w, c.projection([&](auto p) { return p.weight_vjp(w_bar); })};
}

inline Vec2 project_jvp(const Camera& c, Vec3 q, Vec3 q_dot, const double k_dot[6]) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    const double w_dot = c.projection([&](auto p) { return p.weight_jvp(q_dot); });
    const Vec2 n_dot{(q_dot.x - w_dot * n.x) * w, (q_dot.y - w_dot * n.y) * w};
    return {c.k[0] * n_dot.x + c.k[1] * n_dot.y + k_dot[0] * n.x + k_dot[1] * n.y + k_dot[2],
            c.k[3] * n_dot.x + c.k[4] * n_dot.y + k_dot[3] * n.x + k_dot[4] * n.y + k_dot[5]};
}

// Normalised image coordinates of a pixel position: n = A⁻¹ (x − c), with A the 2 × 2 part of K and c its last column.
inline Vec2 normalised(const Camera& c, Vec2 x) {
    const double dx = x.x - c.k[2], dy = x.y - c.k[5], *A = c.k_inverse;
    return {A[0] * dx + A[1] * dy, A[2] * dx + A[3] * dy};
}

// δn = −A⁻¹ (δA n + δc). A pixel position is where one looks, and has no derivative.
inline void normalised_vjp(const Camera& c, Vec2 n, Vec2 bar, double k_bar[6]) {
    const double* A = c.k_inverse;
    const Vec2 m{A[0] * bar.x + A[2] * bar.y, A[1] * bar.x + A[3] * bar.y};  // A⁻ᵀ n̄
    k_bar[0] -= m.x * n.x, k_bar[1] -= m.x * n.y, k_bar[2] -= m.x;
    k_bar[3] -= m.y * n.x, k_bar[4] -= m.y * n.y, k_bar[5] -= m.y;
}

inline Vec2 normalised_jvp(const Camera& c, Vec2 n, const double k_dot[6]) {
    const double *A = c.k_inverse, x = k_dot[0] * n.x + k_dot[1] * n.y + k_dot[2],
                 y = k_dot[3] * n.x + k_dot[4] * n.y + k_dot[5];
    return {-(A[0] * x + A[1] * y), -(A[2] * x + A[3] * y)};
}

// ∂n/∂x, backwards: A⁻ᵀ n̄, the cotangent of the pixel position.
inline Vec2 pixel_vjp(const Camera& c, Vec2 n_bar) {
    const double* A = c.k_inverse;
    return {A[0] * n_bar.x + A[2] * n_bar.y, A[1] * n_bar.x + A[3] * n_bar.y};
}

}  // namespace edgegrad
