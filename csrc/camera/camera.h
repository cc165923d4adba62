// Maps points in camera coordinates q = R p + t to pixels and back, each with its _vjp.
//
// A camera is a projection to normalised image coordinates n (projection.h), followed by a lens and the affine map K.
// The lens (lens.h) may distort n to m, and K maps m to pixels. K n is the undistorted image; for a pinhole it is the
// image. World coordinates enter only at the ends. Vertices are transformed once, and the cotangents of q become those
// of p, R and t once, after all samples.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>

#include "camera/lens.h"
#include "camera/projection.h"
#include "core/math.h"

namespace edgegrad {

// Holds the cotangents or tangents of the intrinsics.
struct IntrinsicsGrad {
    double k[6] = {};                         // the upper two rows of K
    double distortion[most_parameters] = {};  // the lens parameters

    IntrinsicsGrad& operator+=(const IntrinsicsGrad& o) {
        for (int i = 0; i < 6; ++i) k[i] += o.k[i];
        for (int i = 0; i < most_parameters; ++i) distortion[i] += o.distortion[i];
        return *this;
    }
};

// Describes what a distorting lens shows: a disc, and the box of the undistorted image, px, that holds all that a pixel
// filter reaches. `most` bounds how far distortion moves positions there: |∂x/∂u| entry by entry. `open` marks the
// borders of a sub-camera's box (sub_cameras.h) that belong to its neighbours, in the order of ViewVolume.
struct LensView {
    LensDisc disc;
    // It is the angle to the axis, radians, where the image ends, if it ends.
    std::optional<double> end;
    Vec2 low, high;
    Mat2 most = {1, 0, 0, 1};
    bool open[4] = {};
};

struct Camera {
    // It rotates from the frame of world_to_camera to that of this sub-camera.
    Mat3 rotation{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    Mat3 R;
    Vec3 t;
    double k[6];  // upper two rows of K: x = k0 n.x + k1 n.y + k2, y = k3 n.x + k4 n.y + k5
    bool perspective;
    int width, height;
    Mat3 R_inverse;
    double k_det;
    double k_inverse[4];     // inverts the 2 × 2 part of K, row by row
    double pixels_per_unit;  // most pixels per unit of normalised image coordinates
    AnyLens lens;
    LensView lens_view;

    // Takes world_to_camera (4, 4) and K (3, 3), row by row.
    Camera(const double* world_to_camera, const double* K, bool perspective_, int width_, int height_,
           const AnyLens& lens_ = PinholeLens())
        : perspective(perspective_), width(width_), height(height_), lens(lens_) {
        for (int i = 0; i < 3; ++i)
            R.row[i] = {world_to_camera[4 * i], world_to_camera[4 * i + 1], world_to_camera[4 * i + 2]};
        // An orthographic view is the same from any distance; zero rounds depths least.
        t = {world_to_camera[3], world_to_camera[7], perspective ? world_to_camera[11] : 0.0};
        std::copy(K, K + 6, k);
        set_inverses();
        if (!is_undistorted() && !has_cube_faces(lens)) look_through_lens();
        with_cube_face_lens(lens, 0, [&](const auto& l) { return set_scale(l.scale()), 0; });
    }

    // Sets K to the scale of a cube face's undistorted image.
    void set_scale(Vec2 scale) {
        std::fill(k, k + 6, 0.0), k[0] = scale.x, k[4] = scale.y;
        set_inverses();
    }

    // Updates the inverses of R and k.
    void set_inverses() {
        R_inverse = inverse(R);
        pixels_per_unit = std::fabs(k[0]) + std::fabs(k[1]) + std::fabs(k[3]) + std::fabs(k[4]);
        k_det = k[0] * k[4] - k[1] * k[3];
        k_inverse[0] = k[4] / k_det, k_inverse[1] = -k[1] / k_det;
        k_inverse[2] = -k[3] / k_det, k_inverse[3] = k[0] / k_det;
    }

    // Returns whether straight edges are straight in the image.
    bool is_undistorted() const { return std::holds_alternative<PinholeLens>(lens); }

    Vec3 to_camera(Vec3 p) const { return R * p + t; }

    // Returns f(Perspective()) or f(Orthographic()).
    template <class F>
    auto projection(F f) const {
        return perspective ? f(Perspective()) : f(Orthographic());
    }

    // These forward to the projection; see Perspective.
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

    // Returns the least length of a pixel in world units at a depth.
    double pixel_at_depth(double z) const { return unit_at_depth(z) / pixels_per_unit; }

    // Returns whether a face with this ratio of depths moves in the image nearly as an affine function of its corners.
    bool is_nearly_affine(double depths) const { return !perspective || depths < 2; }

    // Returns the orientation of (q0, q1, q2) in the image, x to the right and y down: > 0 where (x1 − x0) ∧ (x2 − x0)
    // > 0. The triple product also serves triangles that reach behind the camera. It is one number for the three edges
    // of a face, so that they never disagree. 0 means edge-on: the plane contains the eye, to the precision of doubles.
    int facing(Vec3 q0, Vec3 q1, Vec3 q2) const {
        const Vec3 view = view_direction(q0), e1 = q1 - q0, e2 = q2 - q0;
        const double s = dot(view, cross(e1, e2));
        if (std::fabs(s) <= rounding_of_triple_product(view, e1, e2)) return 0;
        return s * k_det > 0 ? 1 : -1;
    }

    // Returns the roundings of a point's denominator w, relative to itself, if its depth sums terms of this size.
    double roundings_of_weight(double terms, double w) const { return perspective ? terms / w : 1; }

    // Returns a generous bound of the rounding of pixel positions in or near the image. A position sums products with
    // normalised coordinates, which the inverse of K bounds, and the principal point.
    double rounding_of_positions() const {
        const double most = 2.0 * (width + height) + std::fabs(k[2]) + std::fabs(k[5]);
        double inverse = 0;
        for (const double a : k_inverse) inverse += std::fabs(a);
        return 32 * std::numeric_limits<double>::epsilon() * (1 + pixels_per_unit * inverse) * most;
    }

    // Returns the side from which (q0, q1, q2) is seen: 1 or 2. Edge-on, callers accept either.
    uint8_t side(Vec3 q0, Vec3 q1, Vec3 q2) const {
        return dot(view_direction(q0), cross(q1 - q0, q2 - q0)) > 0 ? 1 : 2;
    }

    // Returns a box of the image that contains the image of a box of the undistorted image.
    std::pair<Vec2, Vec2> image_box(Vec2 low, Vec2 high) const;

    // Returns how much distortion stretches lengths in a box of the undistorted image, where that is far from 1.
    double stretch(Vec2 low, Vec2 high) const;

    // Returns the point of the undistorted image around which areas grow as 1 / distance; most cameras have none.
    std::optional<Vec2> pole() const {
        const bool there = with_cube_face_lens(lens, false, [](const auto& l) { return l.has_pole(); });
        return there ? std::optional(Vec2{k[2], k[5]}) : std::nullopt;
    }

    // Returns whether a sub-camera may show something within `reach` px of x.
    bool may_show(Vec2 x, double reach) const {
        return with_cube_face_lens(lens, true, [&](const auto& l) { return l.may_show(x, reach); });
    }

    // Bounds the depth of a face's points in every sub-camera that shows it.
    double greatest_depth(const Vec3 q[3]) const {
        if (!has_cube_faces(lens)) return std::max({q[0].z, q[1].z, q[2].z});
        return std::max({length(q[0]), length(q[1]), length(q[2])});
    }

   private:
    // Finds the visible part, or takes it from the cache. A fisheye with more than one cube face becomes a WideFisheye.
    void look_through_lens();
    void find_lens_view();
    LensView view_through_lens() const;
};

// Returns the position of q in the undistorted image, px.
inline Vec2 project(const Camera& c, Vec3 q) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    return {c.k[0] * n.x + c.k[1] * n.y + c.k[2], c.k[3] * n.x + c.k[4] * n.y + c.k[5]};
}

// Returns x = A m + c, where m is a position in the image, or n in the undistorted image. The _vjp follows.
inline Vec2 to_pixels(const Camera& c, Vec2 m) {
    return {c.k[0] * m.x + c.k[1] * m.y + c.k[2], c.k[3] * m.x + c.k[4] * m.y + c.k[5]};
}
inline void to_pixels_vjp(const Camera& c, Vec2 m, Vec2 bar, Vec2& m_bar, double k_bar[6]) {
    k_bar[0] += bar.x * m.x, k_bar[1] += bar.x * m.y, k_bar[2] += bar.x;
    k_bar[3] += bar.y * m.x, k_bar[4] += bar.y * m.y, k_bar[5] += bar.y;
    m_bar += Vec2{c.k[0] * bar.x + c.k[3] * bar.y, c.k[1] * bar.x + c.k[4] * bar.y};
}

// These serve distorting lenses (distorted.cpp; few cameras have one, and the code is long). They are the _vjp of
// to_pixels(distort(n)); that of n as a function of m; and the same with m itself and the lens parameters, for a
// cotangent m_bar of A⁻¹ x.
void distorted_to_pixels_vjp(const Camera& c, Vec2 n, Vec2 bar, Vec2& n_bar, IntrinsicsGrad& intrinsics);
Vec2 undistorted_vjp(const Camera& c, Vec2 n, Vec2 n_bar);
void undistorted_vjp(const Camera& c, Vec2 n, Vec2& m, Vec2& m_bar, IntrinsicsGrad& intrinsics);

// Returns the tangent of the pixel position of q, distort(project(q)).
Vec2 project_jvp(const Camera& c, Vec3 q, Vec3 q_dot, const IntrinsicsGrad& intrinsics);
inline void project_vjp(const Camera& c, Vec3 q, Vec2 bar, Vec3& q_bar, IntrinsicsGrad& intrinsics) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    Vec2 n_bar;
    if (c.is_undistorted()) to_pixels_vjp(c, n, bar, n_bar, intrinsics.k);
    else distorted_to_pixels_vjp(c, n, bar, n_bar, intrinsics);
    const double w_bar = -(n_bar.x * n.x + n_bar.y * n.y) * w;
    q_bar += Vec3{n_bar.x * w, n_bar.y * w, c.projection([&](auto p) { return p.weight_vjp(w_bar); })};
}

// Returns the tangent of m at fixed n due to the coefficients' tangents; distort_vjp has the adjoint.
Vec2 distort_by_coefficients(const Camera& c, Vec2 n, const double* distortion_dot);

// These return δA m + δc, and A δm.
inline Vec2 to_pixels_by_k(Vec2 m, const double k_dot[6]) {
    return {k_dot[0] * m.x + k_dot[1] * m.y + k_dot[2], k_dot[3] * m.x + k_dot[4] * m.y + k_dot[5]};
}
inline Vec2 scaled_to_pixels(const Camera& c, Vec2 m_dot) {
    return {c.k[0] * m_dot.x + c.k[1] * m_dot.y, c.k[3] * m_dot.x + c.k[4] * m_dot.y};
}

// Returns n = A⁻¹ (u − c) for a position u in the undistorted image. A is the 2 × 2 part of K, and c its last column.
inline Vec2 normalised(const Camera& c, Vec2 u) {
    const double dx = u.x - c.k[2], dy = u.y - c.k[5], *A = c.k_inverse;
    return {A[0] * dx + A[1] * dy, A[2] * dx + A[3] * dy};
}

// Adds the cotangents of the intrinsics for the n that is seen at the pixel position x, where A m(n) + c = x. The pixel
// position has no derivative. With J = ∂m/∂n,
//
//     δn = −J⁻¹ (A⁻¹ (δA m + δc) + ∂m/∂d δd).
inline void normalised_vjp(const Camera& c, Vec2 n, Vec2 bar, IntrinsicsGrad& intrinsics) {
    Vec2 m = n, m_bar{-bar.x, -bar.y};
    if (!c.is_undistorted()) undistorted_vjp(c, n, m, m_bar, intrinsics);
    // It is A⁻ᵀ m̄.
    const double *A = c.k_inverse, x = A[0] * m_bar.x + A[2] * m_bar.y, y = A[1] * m_bar.x + A[3] * m_bar.y;
    double* k_bar = intrinsics.k;
    k_bar[0] += x * m.x, k_bar[1] += x * m.y, k_bar[2] += x;
    k_bar[3] += y * m.x, k_bar[4] += y * m.y, k_bar[5] += y;
}

// Holds where the lens shows a point u of the undistorted image, and the growth of areas there; 0: nowhere.
struct Distorted {
    Vec2 x;
    double area_scale = 1;
};
Distorted distort_by_lens(const Camera& c, Vec2 u);
inline Distorted distort(const Camera& c, Vec2 u) { return c.is_undistorted() ? Distorted{u} : distort_by_lens(c, u); }

// Returns ∂x/∂u · tangent at n, which is A J A⁻¹ · tangent.
Vec2 distort_jvp_by_lens(const Camera& c, Vec2 n, Vec2 tangent);
inline Vec2 distort_jvp(const Camera& c, Vec2 n, Vec2 tangent) {
    return c.is_undistorted() ? tangent : distort_jvp_by_lens(c, n, tangent);
}

// Returns the position in the undistorted image of what is seen at x, or NaN where nothing is.
inline Vec2 undistort(const Camera& c, Vec2 x) {
    if (c.is_undistorted()) return x;
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    const auto n = undistort(c.lens, c.lens_view.disc, normalised(c, x));
    return n ? to_pixels(c, *n) : Vec2{nan, nan};
}

Vec2 normalised_jvp(const Camera& c, Vec2 n, const IntrinsicsGrad& intrinsics);

// These return cotangents of positions from that of n: A⁻ᵀ n̄ in the undistorted image, and that of the pixel.
inline Vec2 place_vjp(const Camera& c, Vec2 n_bar) {
    const double* A = c.k_inverse;
    return {A[0] * n_bar.x + A[2] * n_bar.y, A[1] * n_bar.x + A[3] * n_bar.y};
}
inline Vec2 pixel_vjp(const Camera& c, Vec2 n, Vec2 n_bar) {
    return place_vjp(c, c.is_undistorted() ? n_bar : undistorted_vjp(c, n, n_bar));
}

}  // namespace edgegrad
