// Implements distorting lenses, and all of forward mode.

#include "camera/camera.h"

namespace edgegrad {

Vec2 distort_by_coefficients(const Camera& c, Vec2 n, const double* distortion_dot) {
    const auto along = [&](Vec2 bar) {
        Vec2 ignored;
        double c_bar[most_parameters] = {}, sum = 0;
        with_lens(c.lens, [&](const auto& lens) { lens.distort_vjp(n, bar, ignored, c_bar); });
        for (int i = 0; i < most_parameters; ++i) sum += c_bar[i] * distortion_dot[i];
        return sum;
    };
    return {along({1, 0}), along({0, 1})};
}

void distorted_to_pixels_vjp(const Camera& c, Vec2 n, Vec2 bar, Vec2& n_bar, IntrinsicsGrad& intrinsics) {
    Vec2 m_bar;
    with_lens(c.lens, [&](const auto& lens) {
        to_pixels_vjp(c, lens.distort(n), bar, m_bar, intrinsics.k);
        lens.distort_vjp(n, m_bar, n_bar, intrinsics.distortion);
    });
}

Vec2 undistorted_vjp(const Camera& c, Vec2 n, Vec2 n_bar) {
    return with_lens(c.lens, [&](const auto& lens) { return transposed_times(inverse(lens.jacobian(n)), n_bar); });
}

void undistorted_vjp(const Camera& c, Vec2 n, Vec2& m, Vec2& m_bar, IntrinsicsGrad& intrinsics) {
    with_lens(c.lens, [&](const auto& lens) {
        m = lens.distort(n);
        const Mat2 inverse = edgegrad::inverse(lens.jacobian(n));
        m_bar = transposed_times(inverse, m_bar);
        Vec2 ignored;
        lens.distort_vjp(n, m_bar, ignored, intrinsics.distortion);
    });
}

Distorted distort_by_lens(const Camera& c, Vec2 u) {
    const Vec2 n = normalised(c, u);
    if (!(length(n) < c.lens_view.disc.fold)) return {u, 0};
    return with_lens(c.lens, [&](const auto& lens) {
        return Distorted{to_pixels(c, lens.distort(n)), determinant(lens.jacobian(n))};
    });
}

Vec2 distort_jvp_by_lens(const Camera& c, Vec2 n, Vec2 tangent) {
    const double *A = c.k, *I = c.k_inverse;
    const Vec2 along{I[0] * tangent.x + I[1] * tangent.y, I[2] * tangent.x + I[3] * tangent.y};
    const Vec2 m = with_lens(c.lens, [&](const auto& lens) { return lens.jacobian(n) * along; });
    return {A[0] * m.x + A[1] * m.y, A[3] * m.x + A[4] * m.y};
}

Vec2 project_jvp(const Camera& c, Vec3 q, Vec3 q_dot, const IntrinsicsGrad& intrinsics) {
    const double w = 1.0 / c.depth_weight(q);
    const Vec2 n{q.x * w, q.y * w};
    const double w_dot = c.projection([&](auto p) { return p.weight_jvp(q_dot); });
    const Vec2 n_dot{(q_dot.x - w_dot * n.x) * w, (q_dot.y - w_dot * n.y) * w};
    if (c.is_undistorted()) return scaled_to_pixels(c, n_dot) + to_pixels_by_k(n, intrinsics.k);
    Vec2 m, m_dot = distort_by_coefficients(c, n, intrinsics.distortion);
    with_lens(c.lens, [&](const auto& lens) { m = lens.distort(n), m_dot += lens.jacobian(n) * n_dot; });
    return scaled_to_pixels(c, m_dot) + to_pixels_by_k(m, intrinsics.k);
}

Vec2 normalised_jvp(const Camera& c, Vec2 n, const IntrinsicsGrad& intrinsics) {
    const double* A = c.k_inverse;
    const auto by_pixel = [&](Vec2 x) { return Vec2{A[0] * x.x + A[1] * x.y, A[2] * x.x + A[3] * x.y}; };
    if (c.is_undistorted()) return -1 * by_pixel(to_pixels_by_k(n, intrinsics.k));
    return with_lens(c.lens, [&](const auto& lens) {
        const Vec2 m_dot = by_pixel(to_pixels_by_k(lens.distort(n), intrinsics.k)) +
                           distort_by_coefficients(c, n, intrinsics.distortion);
        return -1 * (inverse(lens.jacobian(n)) * m_dot);
    });
}

}  // namespace edgegrad
