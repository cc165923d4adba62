#include "camera/lens_boundary.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

Vec2 direction(double angle) { return {std::cos(angle), std::sin(angle)}; }
Vec2 turned(Vec2 e) { return {-e.y, e.x}; }
double dot(Vec2 a, Vec2 b) { return a.x * b.x + a.y * b.y; }

// Returns ∂m/∂c at n.
template <RadialLens L>
std::array<Vec2, most_coefficients> by_coefficients(const L& lens, Vec2 n) {
    double x[most_coefficients] = {}, y[most_coefficients] = {};
    Vec2 unused;
    lens.distort_vjp(n, {1, 0}, unused, x), lens.distort_vjp(n, {0, 1}, unused, y);
    std::array<Vec2, most_coefficients> out;
    for (int i = 0; i < most_coefficients; ++i) out[i] = {x[i], y[i]};
    return out;
}

// Returns ∂ρ/∂c. Differences over a millionth of ρ approximate derivatives of ∂m/∂n, with errors of about 1e-9.
template <RadialLens L>
std::array<double, most_coefficients> fold_by_coefficients(const L& lens, const LensDisc& disc) {
    const Vec2 n = folding_place(lens, disc), e = (1 / disc.fold) * n;
    const double h = 1e-6 * disc.fold;
    const Mat2 J = lens.jacobian(n);
    const auto area_scale = [&](Vec2 at) { return determinant(lens.jacobian(at)); };
    const double by_radius = (area_scale(n + h * e) - area_scale(n - h * e)) / (2 * h);
    const auto right = by_coefficients(lens, n + Vec2{h, 0}), left = by_coefficients(lens, n - Vec2{h, 0});
    const auto below = by_coefficients(lens, n + Vec2{0, h}), above = by_coefficients(lens, n - Vec2{0, h});
    std::array<double, most_coefficients> out;
    for (int i = 0; i < most_coefficients; ++i) {
        const Vec2 by_x = (1 / (2 * h)) * (right[i] - left[i]), by_y = (1 / (2 * h)) * (below[i] - above[i]);
        out[i] = -(wedge(by_x, {J.xy, J.yy}) + wedge({J.xx, J.yx}, by_y)) / by_radius;
    }
    return out;
}

}  // namespace

LensBoundary::LensBoundary(const Camera& camera) : camera_(camera) {
    if (const auto* lens = std::get_if<BrownConrady>(&camera.lens);
        lens && (lens->p1 != 0 || lens->p2 != 0) && camera.lens_view.disc.fold < greatest_radius)
        fold_by_ = fold_by_coefficients(*lens, camera.lens_view.disc);
    constexpr int points = 64;
    Box2 all = Box2::empty();
    for (int i = 0; i < points; ++i) all.add(place(2 * M_PI * i / points));
    half_ = 0.5 * (all.high - all.low);
}

LensBoundary::Point LensBoundary::curve_at(double angle) const {
    const Vec2 e = direction(angle);
    Vec2 m, m_tangent;
    if (const auto* wide = std::get_if<WideFisheye>(&camera_.lens)) {
        m = wide->lens_boundary_point(e), m_tangent = wide->lens_boundary_tangent(e);
    } else {
        const Vec2 n = camera_.lens_view.disc.fold * e;
        with_radial_lens(camera_.lens, [&](const auto& lens) {
            m = lens.distort(n), m_tangent = lens.jacobian(n) * (camera_.lens_view.disc.fold * turned(e));
        });
    }
    return {to_pixels(camera_, m), scaled_to_pixels(camera_, m_tangent), {}};
}

std::optional<LensBoundary::Point> LensBoundary::at(double angle) const {
    Point p = curve_at(angle);
    const Vec2 e = direction(angle);
    p.n = camera_.lens_view.disc.fold * e;
    if (const auto* wide = std::get_if<WideFisheye>(&camera_.lens)) {
        const std::optional<Vec2> n = wide->cube_face().place(wide->lens_boundary_direction(e));
        if (!n) return {};
        p.n = *n;
    }
    return p;
}

// Between two points a curve leaves the chord by at most |d²x/dθ²| Δ² / 8. For an ellipse that is half the box; four
// times as much allows generously for decentring.
bool LensBoundary::box(Arc arc, Vec2& low, Vec2& high) const {
    const double turn = arc.to - arc.from;
    if (const auto* wide = std::get_if<WideFisheye>(&camera_.lens)) {
        // Directions lie at most half the arc from the middle one.
        const Vec3 middle = wide->lens_boundary_direction(direction(0.5 * (arc.from + arc.to)));
        if (wide->cube_face().outside(middle) > turn + 1e-9) return false;
    }
    const Vec2 a = place(arc.from), b = place(arc.to), more = 0.5 * turn * turn * half_;
    low = Vec2{std::min(a.x, b.x), std::min(a.y, b.y)} - more;
    high = Vec2{std::max(a.x, b.x), std::max(a.y, b.y)} + more;
    return true;
}

Vec2 LensBoundary::velocity(const Point& p, const IntrinsicsGrad& of) const {
    Vec2 m, m_dot = distort_by_coefficients(camera_, p.n, of.distortion);
    with_lens(camera_.lens, [&](const auto& lens) {
        m = lens.distort(p.n);
        if (!fold_by_) return;
        double fold_dot = 0;
        for (int i = 0; i < most_coefficients; ++i) fold_dot += (*fold_by_)[i] * of.distortion[i];
        m_dot += (fold_dot / length(p.n)) * (lens.jacobian(p.n) * p.n);
    });
    return scaled_to_pixels(camera_, m_dot) + to_pixels_by_k(m, of.k);
}

void LensBoundary::velocity_vjp(const Point& p, Vec2 bar, IntrinsicsGrad& intrinsics) const {
    with_lens(camera_.lens, [&](const auto& lens) {
        Vec2 m_bar, n_bar;
        to_pixels_vjp(camera_, lens.distort(p.n), bar, m_bar, intrinsics.k);
        lens.distort_vjp(p.n, m_bar, n_bar, intrinsics.distortion);
        if (!fold_by_) return;
        const double fold_bar = dot(n_bar, p.n) / length(p.n);
        for (int i = 0; i < most_coefficients; ++i) intrinsics.distortion[i] += fold_bar * (*fold_by_)[i];
    });
}

}  // namespace edgegrad
