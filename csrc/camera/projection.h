// Projects camera coordinates q to normalised image coordinates n along straight rays. A camera selects its projection
// once (Camera::projection); other code does not ask for it.
#pragma once

#include <cmath>
#include <concepts>
#include <limits>

#include "core/math.h"

namespace edgegrad {

// Holds the projective map from normalised image coordinates to barycentrics. With h = (n.x, n.y, 1),
//
//     (u w, v w, w) = M h.
//
// This is the test of Möller and Trumbore 1997, s = o − q0, u = s·(d × e2) / e1·(d × e2), v = d·(s × e1) / e1·(d × e2).
// The ray is taken out of the products, so that the face's part is computed once for all of its samples. Edges instead
// of positions relative to the eye limit the loss to distance / size times the spacing of doubles.
struct FaceMap {
    Vec3 column[3];  // columns of M

    Vec3 times(Vec2 n) const { return n.x * column[0] + n.y * column[1] + column[2]; }
    Vec3 row(double Vec3::* r) const { return {column[0].*r, column[1].*r, column[2].*r}; }
};

// Holds the rows of a FaceMap, (u w, v w, w) = (U · h, V · h, D · h). A face has the sides e1 = q1 − q0 and e2 = q2 −
// q0, and s = −q0.
struct FaceRows {
    Vec3 U, V, D;
};
struct FaceSides {
    Vec3 e1, e2, s;
};

// All rays meet in the eye: n = (X/Z, Y/Z), and the ray at n has o = 0 and d = h.
struct Perspective {
    // These return the denominator of the projection, its cotangent as one of Z, and its tangent.
    static double weight(Vec3 q) { return q.z; }
    static double weight_vjp(double bar) { return bar; }
    static double weight_jvp(Vec3 q_dot) { return q_dot.z; }

    // Returns the direction from the viewer to q.
    static Vec3 view_direction(Vec3 q) { return q; }

    // Returns the world units per unit of n at a depth.
    static double unit_at_depth(double z) { return z; }

    // Returns whether the plane of a face contains the eye, to double precision. The face is then edge-on and covers
    // nothing, though every ray meets its plane in the eye.
    static bool passes_through_eye(const Vec3 q[3]) {
        const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0];
        return std::fabs(dot(q[0], cross(e1, e2))) <= rounding_of_triple_product(q[0], e1, e2);
    }

    static FaceRows face_rows(FaceSides f) { return {cross(f.e2, f.s), cross(f.s, f.e1), cross(f.e2, f.e1)}; }
    static void face_rows_vjp(FaceSides f, FaceRows bar, FaceSides& f_bar) {
        cross_vjp(f.e2, f.s, bar.U, f_bar.e2, f_bar.s);
        cross_vjp(f.s, f.e1, bar.V, f_bar.s, f_bar.e1);
        cross_vjp(f.e2, f.e1, bar.D, f_bar.e2, f_bar.e1);
    }

    static FaceRows face_rows_jvp(FaceSides f, FaceSides dot) {
        return {cross(dot.e2, f.s) + cross(f.e2, dot.s), cross(dot.s, f.e1) + cross(f.s, dot.e1),
                cross(dot.e2, f.e1) + cross(f.e2, dot.e1)};
    }

    // 1/z is affine in n along a plane. These return its slope with respect to z, and with respect to n on the plane
    // with the normal N through q: 1/z = N · (n, 1) / N · q.
    static double affine_depth_slope(double z) { return -1 / (z * z); }
    static Vec2 affine_depth_gradient(Vec3 N, Vec3 q) { return (1 / dot(N, q)) * Vec2{N.x, N.y}; }

    // Returns N · dq/dz along the ray at n, q = z (n, 1).
    static double along_ray(Vec3 N, Vec2 n) { return N.x * n.x + N.y * n.y + N.z; }

    // In the plane of a face 1/z is affine in n, because D · (z h) = D · q0. These return its coefficients, and the
    // greatest depth where 1/z is value ± change. Beyond the horizon, or with NaN, `most` is the bound.
    static Vec3 depth_plane(const Vec3 q[3], FaceRows m) { return (1 / dot(q[0], m.D)) * m.D; }
    static double farthest(double value, double change, double most) {
        return value > change ? std::fmin(most, 1 / (value - change)) : most;
    }
};

// All rays run along the axis: n = (X, Y), and the ray at n has o = (n.x, n.y, 0) and d = (0, 0, 1).
struct Orthographic {
    static double weight(Vec3) { return 1; }
    static double weight_vjp(double) { return 0; }
    static double weight_jvp(Vec3) { return 0; }
    static Vec3 view_direction(Vec3) { return {0, 0, 1}; }
    static double unit_at_depth(double) { return 1; }
    static bool passes_through_eye(const Vec3*) { return false; }

    static FaceRows face_rows(FaceSides f) {
        const auto& [e1, e2, s] = f;
        return {{-e2.y, e2.x, s.y * e2.x - s.x * e2.y},
                {e1.y, -e1.x, s.x * e1.y - s.y * e1.x},
                {0, 0, e2.x * e1.y - e2.y * e1.x}};
    }
    static void face_rows_vjp(FaceSides f, FaceRows bar, FaceSides& f_bar) {
        const auto& [e1, e2, s] = f;
        const auto& [U, V, D] = bar;
        f_bar.e2 += {U.y + s.y * U.z + e1.y * D.z, -U.x - s.x * U.z - e1.x * D.z, 0};
        f_bar.e1 += {-V.y - s.y * V.z - e2.y * D.z, V.x + s.x * V.z + e2.x * D.z, 0};
        f_bar.s += {e1.y * V.z - e2.y * U.z, e2.x * U.z - e1.x * V.z, 0};
    }

    static FaceRows face_rows_jvp(FaceSides f, FaceSides dot) {
        const auto& [U, V, D] = Perspective::face_rows_jvp(f, dot);
        return {{-dot.e2.y, dot.e2.x, U.z}, {dot.e1.y, -dot.e1.x, V.z}, {0, 0, D.z}};
    }

    // Uses −z = (N_x n_x + N_y n_y − N · q) / N_z, and q = (n, z).
    static double affine_depth_slope(double) { return -1; }
    static Vec2 affine_depth_gradient(Vec3 N, Vec3) { return (1 / N.z) * Vec2{N.x, N.y}; }
    static double along_ray(Vec3 N, Vec2) { return N.z; }

    // Here z itself is affine.
    static Vec3 depth_plane(const Vec3 q[3], FaceRows m) {
        return (1 / m.D.z) * ((q[1].z - q[0].z) * m.U + (q[2].z - q[0].z) * m.V) + Vec3{0, 0, q[0].z};
    }
    static double farthest(double value, double change, double most) { return std::fmin(most, value + change); }
};

template <class P>
concept Projection = requires(Vec3 q, const Vec3* face, double x, FaceSides f, FaceSides& f_bar, FaceRows m) {
    { P::weight(q) } -> std::same_as<double>;
    { P::weight_vjp(x) } -> std::same_as<double>;
    { P::weight_jvp(q) } -> std::same_as<double>;
    { P::view_direction(q) } -> std::same_as<Vec3>;
    { P::unit_at_depth(x) } -> std::same_as<double>;
    { P::passes_through_eye(face) } -> std::same_as<bool>;
    { P::face_rows(f) } -> std::same_as<FaceRows>;
    P::face_rows_vjp(f, m, f_bar);
    { P::face_rows_jvp(f, f) } -> std::same_as<FaceRows>;
    { P::affine_depth_slope(x) } -> std::same_as<double>;
    { P::affine_depth_gradient(q, q) } -> std::same_as<Vec2>;
    { P::along_ray(q, Vec2()) } -> std::same_as<double>;
    { P::depth_plane(face, m) } -> std::same_as<Vec3>;
    { P::farthest(x, x, x) } -> std::same_as<double>;
};
static_assert(Projection<Perspective> && Projection<Orthographic>);

}  // namespace edgegrad
