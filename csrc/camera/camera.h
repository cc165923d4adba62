// Cameras: point → pixel and back, in camera coordinates q = R p + t; each with its _vjp.
//
// A camera is a projection to normalised image coordinates n (projection.h), a lens that may bend these to m (lens.h),
// and the affine map K of m. K n is the undistorted image; of a pinhole it is the image. World coordinates come in only
// at the ends: vertices are transformed once, and the cotangents of q are turned into those of p, R and t once, when
// all samples are done.
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

// Cotangents, or tangents, of what an image is made with.
struct IntrinsicsGrad {
    double k[6] = {};                         // the upper rows of K
    double distortion[most_parameters] = {};  // of the lens

    IntrinsicsGrad& operator+=(const IntrinsicsGrad& o) {
        for (int i = 0; i < 6; ++i) k[i] += o.k[i];
        for (int i = 0; i < most_parameters; ++i) distortion[i] += o.distortion[i];
        return *this;
    }
};

// What is visible through a lens that distorts: a disc, and the box of the undistorted image, px, in which all lies
// that a pixel filter reaches; and how far bending moves places there, at most: |∂x/∂u| entry by entry. Of a sub-camera
// (sub_cameras.h): which borders of its box, in the order of ViewVolume, belong to its neighbours.
struct LensView {
    LensDisc disc;
    // The angle to the axis, radians, where the image ends; none if it does not.
    std::optional<double> end;
    Vec2 low, high;
    Mat2 most = {1, 0, 0, 1};
    bool open[4] = {};
};

struct Camera {
    Mat3 turn{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};  // from the frame of world_to_camera to that of this sub-camera
    Mat3 R;
    Vec3 t;
    double k[6];  // the upper two rows of K: x = k0 n.x + k1 n.y + k2, y = k3 n.x + k4 n.y + k5
    bool perspective;
    int width, height;
    Mat3 R_inverse;
    double k_det;
    double k_inverse[4];     // of the 2 × 2 part of K, row by row
    double pixels_per_unit;  // at most, of normalised image coordinates
    AnyLens lens;
    LensView lens_view;

    // world_to_camera (4, 4) and K (3, 3), row by row.
    Camera(const double* world_to_camera, const double* K, bool perspective_, int width_, int height_,
           const AnyLens& lens_ = PinholeLens())
        : perspective(perspective_), width(width_), height(height_), lens(lens_) {
        for (int i = 0; i < 3; ++i)
            R.row[i] = {world_to_camera[4 * i], world_to_camera[4 * i + 1], world_to_camera[4 * i + 2]};
        // An orthographic view is the same from any distance; from none, depths are rounded least.
        t = {world_to_camera[3], world_to_camera[7], perspective ? world_to_camera[11] : 0.0};
        std::copy(K, K + 6, k);
        set_inverses();
        if (!is_undistorted() && !has_sides(lens)) look_through_lens();
        with_side_lens(lens, 0, [&](const auto& l) { return set_scale(l.scale()), 0; });
    }

    // Of the undistorted image of a side.
    void set_scale(Vec2 scale) {
        std::fill(k, k + 6, 0.0), k[0] = scale.x, k[4] = scale.y;
        set_inverses();
    }

    // Of R and k, where these are set.
    void set_inverses() {
        R_inverse = inverse(R);
        pixels_per_unit = std::fabs(k[0]) + std::fabs(k[1]) + std::fabs(k[3]) + std::fabs(k[4]);
        k_det = k[0] * k[4] - k[1] * k[3];
        k_inverse[0] = k[4] / k_det, k_inverse[1] = -k[1] / k_det;
        k_inverse[2] = -k[3] / k_det, k_inverse[3] = k[0] / k_det;
    }

    // Whether straight edges are straight in the image.
    bool is_undistorted() const { return std::holds_alternative<PinholeLens>(lens); }

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
    // say.
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

    // A box of the image in which all of a box of the undistorted image is seen.
    std::pair<Vec2, Vec2> image_box(Vec2 low, Vec2 high) const;

    // How much longer what lies in a box of the undistorted image may be in the image, where that is far from one.
    double stretch(Vec2 low, Vec2 high) const;

    // The place in the undistorted image around which areas grow as 1 / distance; none for most.
    std::optional<Vec2> pole() const {
        const bool there = with_side_lens(lens, false, [](const auto& l) { return l.has_pole(); });
        return there ? std::optional(Vec2{k[2], k[5]}) : std::nullopt;
    }

    // Whether a sub-camera may show something within `reach` px of x.
    bool may_show(Vec2 x, double reach) const {
        return with_side_lens(lens, true, [&](const auto& l) { return l.may_show(x, reach); });
    }

    // No point of a face has a greater depth, in no sub-camera that shows it.
    double greatest_depth(const Vec3 q[3]) const {
        if (!has_sides(lens)) return std::max({q[0].z, q[1].z, q[2].z});
        return std::max({length(q[0]), length(q[1]), length(q[2])});
    }

   private:
    // Finds out what is visible, or remembers it; a fisheye that shows more than one side becomes a wide one.
    void look_through_lens();
    void find_lens_view();
    LensView view_through_lens() const;
};

// Position of q in the undistorted image, px.
inline Vec2 project(const Camera& c, Vec3 q) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    return {c.k[0] * n.x + c.k[1] * n.y + c.k[2], c.k[3] * n.x + c.k[4] * n.y + c.k[5]};
}

// x = A m + c and its derivative; a place in m, or in n for the undistorted image.
inline Vec2 to_pixels(const Camera& c, Vec2 m) {
    return {c.k[0] * m.x + c.k[1] * m.y + c.k[2], c.k[3] * m.x + c.k[4] * m.y + c.k[5]};
}
inline void to_pixels_vjp(const Camera& c, Vec2 m, Vec2 bar, Vec2& m_bar, double k_bar[6]) {
    k_bar[0] += bar.x * m.x, k_bar[1] += bar.x * m.y, k_bar[2] += bar.x;
    k_bar[3] += bar.y * m.x, k_bar[4] += bar.y * m.y, k_bar[5] += bar.y;
    m_bar += Vec2{c.k[0] * bar.x + c.k[3] * bar.y, c.k[1] * bar.x + c.k[4] * bar.y};
}

// Through a lens that is not straight (distorted.cpp; few cameras have one, and it is much code): backwards,
// to_pixels of n bent to m; and n of m, alone or with m itself and the lens's coefficients, of a cotangent m_bar of A⁻¹
// x.
void distorted_to_pixels_vjp(const Camera& c, Vec2 n, Vec2 bar, Vec2& n_bar, IntrinsicsGrad& intrinsics);
Vec2 undistorted_vjp(const Camera& c, Vec2 n, Vec2 n_bar);
void undistorted_vjp(const Camera& c, Vec2 n, Vec2& m, Vec2& m_bar, IntrinsicsGrad& intrinsics);

// Of bend(project(q)): the pixel position of q.
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

// Tangents of the coefficients, as those of m at fixed n: the rows of what distort_vjp is the adjoint of.
Vec2 distort_by_coefficients(const Camera& c, Vec2 n, const double* distortion_dot);

// δA m + δc, and A δm.
inline Vec2 to_pixels_by_k(Vec2 m, const double k_dot[6]) {
    return {k_dot[0] * m.x + k_dot[1] * m.y + k_dot[2], k_dot[3] * m.x + k_dot[4] * m.y + k_dot[5]};
}
inline Vec2 scaled_to_pixels(const Camera& c, Vec2 m_dot) {
    return {c.k[0] * m_dot.x + c.k[1] * m_dot.y, c.k[3] * m_dot.x + c.k[4] * m_dot.y};
}

// n = A⁻¹ (u − c) of a place in the undistorted image, with A the 2 × 2 part of K and c its last column.
inline Vec2 normalised(const Camera& c, Vec2 u) {
    const double dx = u.x - c.k[2], dy = u.y - c.k[5], *A = c.k_inverse;
    return {A[0] * dx + A[1] * dy, A[2] * dx + A[3] * dy};
}

// Of what is seen at a pixel position x, A m(n) + c = x. The pixel position has no derivative: with J = ∂m/∂n,
//
//     δn = −J⁻¹ (A⁻¹ (δA m + δc) + ∂m/∂d δd).
inline void normalised_vjp(const Camera& c, Vec2 n, Vec2 bar, IntrinsicsGrad& intrinsics) {
    Vec2 m = n, m_bar{-bar.x, -bar.y};
    if (!c.is_undistorted()) undistorted_vjp(c, n, m, m_bar, intrinsics);
    const double *A = c.k_inverse, x = A[0] * m_bar.x + A[2] * m_bar.y, y = A[1] * m_bar.x + A[3] * m_bar.y;  // A⁻ᵀ m̄
    double* k_bar = intrinsics.k;
    k_bar[0] += x * m.x, k_bar[1] += x * m.y, k_bar[2] += x;
    k_bar[3] += y * m.x, k_bar[4] += y * m.y, k_bar[5] += y;
}

// Where the place u of the undistorted image is seen, and how much larger an area is there; 0: nowhere.
struct Distorted {
    Vec2 x;
    double area_scale = 1;
};
Distorted distort_by_lens(const Camera& c, Vec2 u);
inline Distorted distort(const Camera& c, Vec2 u) { return c.is_undistorted() ? Distorted{u} : distort_by_lens(c, u); }

// ∂x/∂u · tangent, at the place n: A J A⁻¹.
Vec2 distort_jvp_by_lens(const Camera& c, Vec2 n, Vec2 tangent);
inline Vec2 distort_jvp(const Camera& c, Vec2 n, Vec2 tangent) {
    return c.is_undistorted() ? tangent : distort_jvp_by_lens(c, n, tangent);
}

// The place in the undistorted image of what is seen at x; not numbers where nothing is.
inline Vec2 undistort(const Camera& c, Vec2 x) {
    if (c.is_undistorted()) return x;
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    const auto n = undistort(c.lens, c.lens_view.disc, normalised(c, x));
    return n ? to_pixels(c, *n) : Vec2{nan, nan};
}

Vec2 normalised_jvp(const Camera& c, Vec2 n, const IntrinsicsGrad& intrinsics);

// ∂n/∂u, backwards: A⁻ᵀ n̄, the cotangent of the place in the undistorted image; and that of the pixel position.
inline Vec2 place_vjp(const Camera& c, Vec2 n_bar) {
    const double* A = c.k_inverse;
    return {A[0] * n_bar.x + A[2] * n_bar.y, A[1] * n_bar.x + A[3] * n_bar.y};
}
inline Vec2 pixel_vjp(const Camera& c, Vec2 n, Vec2 n_bar) {
    return place_vjp(c, c.is_undistorted() ? n_bar : undistorted_vjp(c, n, n_bar));
}

}  // namespace edgegrad
