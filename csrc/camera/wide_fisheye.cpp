#include "camera/wide_fisheye.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

constexpr int steps = 512;

double lens_boundary_of(const Fisheye& fisheye) {
    const std::vector<double> turns = fisheye.turning_angles(M_PI);
    return turns.empty() ? M_PI : turns.front();
}

// Returns θ in [low, high] with θ' = m. It takes Newton steps, each of which doubles the digits, and bisects where they
// leave the bracket.
double angle_between(const Fisheye& fisheye, double low, double high, double m) {
    double angle = 0.5 * (low + high);
    for (int i = 0; i < 64; ++i) {
        const double error = fisheye.at_angle(angle) - m;
        (error < 0 ? low : high) = angle;
        const double next = angle - error / fisheye.slope_at_angle(angle);
        if (std::fabs(next - angle) <= 1e-8) return std::clamp(next, low, high);
        angle = next > low && next < high ? next : 0.5 * (low + high);
    }
    return angle;
}

std::vector<double> angles_at_steps(const Fisheye& fisheye, double lens_boundary, double reach) {
    std::vector<double> out{0};
    for (int i = 1; i < steps; ++i) out.push_back(angle_between(fisheye, out.back(), lens_boundary, reach * i / steps));
    out.push_back(lens_boundary);
    return out;
}

}  // namespace

WideFisheye::WideFisheye(const double* K, const Fisheye& fisheye)
    : fisheye_(fisheye),
      cube_face_(cube_faces[5]),
      lens_boundary_(lens_boundary_of(fisheye)),
      reach_(fisheye.at_angle(lens_boundary_)),
      angles_(std::make_shared<const std::vector<double>>(angles_at_steps(fisheye, lens_boundary_, reach_))) {
    std::copy(K, K + 6, k_);
    const double det = k_[0] * k_[4] - k_[1] * k_[3], size = std::sqrt(std::fabs(det));
    inverse_[0] = k_[4] / det, inverse_[1] = -k_[1] / det, inverse_[2] = -k_[3] / det, inverse_[3] = k_[0] / det;
    scale_ = {size, det < 0 ? -size : size};
}

WideFisheye WideFisheye::through(const CubeFace& cube_face) const {
    WideFisheye out = *this;
    out.cube_face_ = cube_face;
    return out;
}

Mat3 WideFisheye::rotation() const {
    Mat3 out;
    for (int i = 0; i < 3; ++i) {
        const Vec3 d = cube_face_.rotation.row[i];
        out.row[i] = {d.x, d.z, -d.y};
    }
    return out;
}

WideFisheye::Polar WideFisheye::polar(Vec3 d) {
    const double sine = std::hypot(d.x, d.z);
    return {std::atan2(sine, -d.y), sine, sine > 0 ? Vec2{d.x / sine, d.z / sine} : Vec2{}};
}

Vec3 WideFisheye::direction_of(double angle, Vec2 along) {
    const double s = std::sin(angle);
    return {s * along.x, -std::cos(angle), s * along.y};
}

Vec2 WideFisheye::m_of_pixel(Vec2 x) const {
    const double dx = x.x - k_[2], dy = x.y - k_[5];
    return {inverse_[0] * dx + inverse_[1] * dy, inverse_[2] * dx + inverse_[3] * dy};
}

Vec2 WideFisheye::scaled(Vec2 m) const {
    return {(k_[0] * m.x + k_[1] * m.y) / scale_.x, (k_[3] * m.x + k_[4] * m.y) / scale_.y};
}

Vec2 WideFisheye::distort(Vec2 n) const {
    const Polar p = polar(cube_face_.direction(n));
    return scaled(fisheye_.at_angle(p.angle) * p.along) + Vec2{k_[2] / scale_.x, k_[5] / scale_.y};
}

// Uses e = m / |m| and ρ = |(d.x, d.z)|: δm = e ∂θ'/∂θ δθ + θ'/ρ (1 − e eᵀ) (δd.x, δd.z), where δθ = (ρ δd.y − d.y e ·
// (δd.x, δd.z)) / |d|². On the axis δm = (δd.x, δd.z) / −d.y.
Mat2 WideFisheye::jacobian(Vec2 n) const {
    const Vec3 d = cube_face_.direction(n);
    const Polar p = polar(d);
    if (!(p.angle < lens_boundary_)) return {0, 0, 0, 0};
    const auto column = [&](Vec3 dot) {
        const Vec2 across{dot.x, dot.z};
        if (!(p.sine > 0)) return scaled((-1 / d.y) * across);
        const double outwards = p.along.x * across.x + p.along.y * across.y;
        const double angle_dot = (p.sine * dot.y - d.y * outwards) / edgegrad::dot(d, d);
        return scaled((fisheye_.slope_at_angle(p.angle) * angle_dot) * p.along +
                      (fisheye_.at_angle(p.angle) / p.sine) * (across - outwards * p.along));
    };
    const Vec2 x = column(cube_face_.rotation.row[0]), y = column(cube_face_.rotation.row[1]);  // ∂d/∂n
    return {x.x, y.x, x.y, y.y};
}

void WideFisheye::distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* c_bar) const {
    n_bar += transposed_times(jacobian(n), bar);
    const Polar p = polar(cube_face_.direction(n));
    const Vec2 m = fisheye_.at_angle(p.angle) * p.along;
    const double x = bar.x / scale_.x, y = bar.y / scale_.y;
    c_bar[0] += x * m.x, c_bar[1] += x * m.y, c_bar[2] += x;
    c_bar[3] += y * m.x, c_bar[4] += y * m.y, c_bar[5] += y;
    double power = ((k_[0] * x + k_[3] * y) * p.along.x + (k_[1] * x + k_[4] * y) * p.along.y) * p.angle;
    for (int i = 0; i < Fisheye::coefficients; ++i) c_bar[6 + i] += power *= p.angle * p.angle;
}

double WideFisheye::angle_below(double m) const {
    const double i = std::floor(m / reach_ * steps) - 1;
    return (*angles_)[int(std::clamp(i, 0.0, double(steps)))];
}
double WideFisheye::angle_above(double m) const {
    const double i = std::ceil(m / reach_ * steps) + 1;
    return (*angles_)[int(std::clamp(i, 0.0, double(steps)))];
}
double WideFisheye::angle(double m) const {
    return m < reach_ ? angle_between(fisheye_, angle_below(m), angle_above(m), m) : lens_boundary_;
}

std::optional<Vec2> WideFisheye::undistort(Vec2 m) const {
    const Vec2 at = m_of_pixel({scale_.x * m.x, scale_.y * m.y});
    const double size = length(at);
    if (!(size < reach_)) return {};
    return cube_face_.place(direction_of(angle(size), size > 0 ? (1 / size) * at : Vec2{}));
}

// Directions within the circle are at most half the range of angles plus the arc from the middle one.
bool WideFisheye::may_show(Vec2 x, double reach) const {
    const Vec2 m = m_of_pixel(x);
    const double size = length(m), step = reach * length(Vec2{std::fabs(inverse_[0]) + std::fabs(inverse_[1]),
                                                              std::fabs(inverse_[2]) + std::fabs(inverse_[3])});
    if (!(size - step < reach_)) return false;
    const double low = angle_below(std::max(0.0, size - step)), high = angle_above(size + step);
    const double arc = step < size ? std::asin(step / size) : M_PI;
    const double far = 0.5 * (high - low) + arc * std::min(high, 1.0);
    return cube_face_.outside(direction_of(0.5 * (low + high), size > 0 ? (1 / size) * m : Vec2{0, 1})) <=
           2 * far + 1e-9;
}

Box2 WideFisheye::image_box(Box2 n) const {
    const Box2 a = cube_face_.angles(n);
    const auto radius = [&](double latitude) {
        return fisheye_.at_angle(std::clamp(latitude + 0.5 * M_PI, 0.0, lens_boundary_));
    };
    const Box2 m = sector_box(radius(a.low.y), radius(a.high.y), a.low.x, a.high.x);
    Box2 out = Box2::empty();
    for (const double x : {m.low.x, m.high.x})
        for (const double y : {m.low.y, m.high.y})
            out.add({k_[0] * x + k_[1] * y + k_[2], k_[3] * x + k_[4] * y + k_[5]});
    return out;
}

std::optional<Box2> WideFisheye::cube_face_box(Box2 x) const {
    const Vec2 corner[4] = {m_of_pixel(x.low), m_of_pixel({x.high.x, x.low.y}), m_of_pixel(x.high),
                            m_of_pixel({x.low.x, x.high.y})};
    const bool around = k_[2] >= x.low.x && k_[2] <= x.high.x && k_[5] >= x.low.y && k_[5] <= x.high.y;
    // The loop bounds |m|, and λ relative to the first corner's.
    double nearest = std::numeric_limits<double>::infinity(), farthest = 0, before = 0, after = 0;
    const double first = std::atan2(corner[0].x, corner[0].y);
    for (int i = 0; i < 4; ++i) {
        const Vec2 a = corner[i], side = corner[(i + 1) % 4] - a;
        const double t = std::clamp(-(a.x * side.x + a.y * side.y) / (side.x * side.x + side.y * side.y), 0.0, 1.0);
        nearest = std::min(nearest, length(a + t * side)), farthest = std::max(farthest, length(a));
        const double turn = std::remainder(std::atan2(a.x, a.y) - first, 2 * M_PI);
        before = std::min(before, turn), after = std::max(after, turn);
    }
    if (around) nearest = 0;
    if (!(nearest < reach_)) return {};
    constexpr double rounding = 1e-12;  // generous bound for angles
    Vec2 from{first + before, angle_below(nearest) - 0.5 * M_PI}, to{first + after, angle_above(farthest) - 0.5 * M_PI};
    if (around || from.x <= -M_PI || to.x >= M_PI) from.x = -M_PI, to.x = M_PI;
    return cube_face_.box({from.x - rounding, from.y - rounding}, {to.x + rounding, to.y + rounding});
}

// Returns the stretch of an arc around the axis, at half the box's size from the antipode or farther.
double WideFisheye::stretch(Box2 n) const {
    const Polar p = polar(cube_face_.direction(middle(n)));
    const double least = has_pole() ? 0.5 * farthest_radius(n) : 1e-9;
    return std::max(1.0, fisheye_.at_angle(std::min(p.angle, lens_boundary_)) / std::max(p.sine, least));
}

Vec2 WideFisheye::lens_boundary_point(Vec2 e) const {
    return scaled(reach_ * e) + Vec2{k_[2] / scale_.x, k_[5] / scale_.y};
}
Vec2 WideFisheye::lens_boundary_tangent(Vec2 e) const { return scaled(reach_ * Vec2{-e.y, e.x}); }

bool WideFisheye::ends_in(Box2 x) const {
    double farthest = 0;
    for (const Vec2 corner : {x.low, {x.high.x, x.low.y}, x.high, {x.low.x, x.high.y}})
        farthest = std::max(farthest, length(m_of_pixel(corner)));
    return !(farthest < reach_);
}

}  // namespace edgegrad
