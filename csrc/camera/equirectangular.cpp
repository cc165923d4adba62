#include "camera/equirectangular.h"

#include <algorithm>

namespace edgegrad {

namespace {

Vec3 direction_of(Vec2 angles) {
    const double c = std::cos(angles.y);
    return {c * std::sin(angles.x), std::sin(angles.y), c * std::cos(angles.x)};
}

}  // namespace

Equirectangular::Equirectangular(const double* K, const CubeFace& cube_face, const Branch& branch)
    : cube_face_(cube_face), branch_(branch) {
    std::copy(K, K + 6, k_);
    const double det = k_[0] * k_[4] - k_[1] * k_[3], size = std::sqrt(std::fabs(det));
    inverse_[0] = k_[4] / det, inverse_[1] = -k_[1] / det, inverse_[2] = -k_[3] / det, inverse_[3] = k_[0] / det;
    // The image is mirrored over a pole.
    scale_ = {size, (det < 0) != (branch.over % 2 != 0) ? -size : size};
}

Vec2 Equirectangular::angles_at(Vec3 d) const {
    const double latitude = std::atan2(d.y, std::sqrt(d.x * d.x + d.z * d.z));
    return {std::atan2(d.x, d.z) + M_PI * branch_.across,
            branch_.over % 2 ? M_PI * branch_.over - latitude : M_PI * branch_.over + latitude};
}

Vec2 Equirectangular::angles_of_pixel(Vec2 x) const {
    const double dx = x.x - k_[2], dy = x.y - k_[5];
    return {inverse_[0] * dx + inverse_[1] * dy, inverse_[2] * dx + inverse_[3] * dy};
}

Vec2 Equirectangular::distort(Vec2 n) const {
    const Vec2 a = angles_at(cube_face_.direction(n));
    return {(k_[0] * a.x + k_[1] * a.y + k_[2]) / scale_.x, (k_[3] * a.x + k_[4] * a.y + k_[5]) / scale_.y};
}

// Uses ∂λ/∂d = (d.z, 0, −d.x) / h² and ∂φ/∂d = (−d.y d.x / h, h, −d.y d.z / h) / |d|². At the pole, where these do not
// exist, it returns zero.
Mat2 Equirectangular::jacobian(Vec2 n) const {
    const Vec3 d = cube_face_.direction(n);
    const double h2 = d.x * d.x + d.z * d.z, h = std::sqrt(h2), all = h2 + d.y * d.y;
    if (!(h2 > 0)) return {0, 0, 0, 0};
    const double sign = branch_.over % 2 ? -1 : 1;
    const Vec3 longitude = (1 / h2) * Vec3{d.z, 0, -d.x},
               latitude = (sign / all) * Vec3{-d.y * d.x / h, h, -d.y * d.z / h};
    const Vec3 along[2] = {cube_face_.rotation.row[0], cube_face_.rotation.row[1]};  // ∂d/∂n
    double a[2][2];
    for (int i = 0; i < 2; ++i) a[0][i] = dot(longitude, along[i]), a[1][i] = dot(latitude, along[i]);
    const auto row = [&](int r, int i) { return k_[3 * r] * a[0][i] + k_[3 * r + 1] * a[1][i]; };
    return {row(0, 0) / scale_.x, row(0, 1) / scale_.x, row(1, 0) / scale_.y, row(1, 1) / scale_.y};
}

void Equirectangular::distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* k_bar) const {
    n_bar += transposed_times(jacobian(n), bar);
    const Vec2 a = angles_at(cube_face_.direction(n));
    const double x = bar.x / scale_.x, y = bar.y / scale_.y;
    k_bar[0] += x * a.x, k_bar[1] += x * a.y, k_bar[2] += x;
    k_bar[3] += y * a.x, k_bar[4] += y * a.y, k_bar[5] += y;
}

std::optional<Vec2> Equirectangular::undistort(Vec2 m) const {
    const Vec2 a = angles_of_pixel({scale_.x * m.x, scale_.y * m.y}), from = branch_.from, to = branch_.to;
    if (!(a.x >= from.x && a.x < to.x && a.y >= from.y && a.y < to.y)) return {};
    return cube_face_.place(direction_of(a));
}

namespace {

// Bounds the steps from a pixel's centre to its samples; larger ones would lose digits in the series below.
constexpr double small_step = 0.06;

// Holds the direction at a pixel's centre, around which the samples' directions are expanded in series.
struct PixelExpansion {
    double to_angles[4];    // maps m − m0 to angles
    Vec2 m0, sine, cosine;  // of both angles at m0
    Vec2 from, to;          // bounds of this position's angles, relative to those at m0
    CubeFace cube_face;
};

// These return sin δ and cos δ by their series.
[[gnu::always_inline]] inline double small_sine(double d) {
    const double s = d * d;
    return d * (1 - s * (1.0 / 6) * (1 - s * (1.0 / 20) * (1 - s * (1.0 / 42))));
}
[[gnu::always_inline]] inline double small_cosine(double d) {
    const double s = d * d;
    return 1 - s * 0.5 * (1 - s * (1.0 / 12) * (1 - s * (1.0 / 30) * (1 - s * (1.0 / 56))));
}

EDGEGRAD_VECTORIZED void undistort_samples(const PixelExpansion& p, int k, double* x, double* y) {
    const PixelExpansion l = p;
    const Mat3 rotation = l.cube_face.rotation;
    const double open = l.cube_face.closed ? 0 : 1;
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    for (int i = 0; i < k; ++i) {
        const double dx = x[i] - l.m0.x, dy = y[i] - l.m0.y;
        const double across = l.to_angles[0] * dx + l.to_angles[1] * dy;
        const double over = l.to_angles[2] * dx + l.to_angles[3] * dy;
        const double sx = small_sine(across), cx = small_cosine(across), sy = small_sine(over), cy = small_cosine(over);
        const double c = l.cosine.y * cy - l.sine.y * sy;
        const double d0 = c * (l.sine.x * cx + l.cosine.x * sx), d1 = l.sine.y * cy + l.cosine.y * sy,
                     d2 = c * (l.cosine.x * cx - l.sine.x * sx);
        const double q0 = rotation.row[0].x * d0 + rotation.row[0].y * d1 + rotation.row[0].z * d2;
        const double q1 = rotation.row[1].x * d0 + rotation.row[1].y * d1 + rotation.row[1].z * d2;
        const double q2 = rotation.row[2].x * d0 + rotation.row[2].y * d1 + rotation.row[2].z * d2;
        // The tests are those of CubeFace::place.
        const bool within = (q2 > 0) & (std::fabs(q0) <= q2) & (std::fabs(q1) <= q2);
        const bool foreign = (open > 0) & ((q0 == q2) | (std::fabs(q1) == q2));
        const bool here = (across >= l.from.x) & (across < l.to.x) & (over >= l.from.y) & (over < l.to.y);
        const bool seen = within & !foreign & here;
        x[i] = seen ? q0 / q2 : nan, y[i] = seen ? q1 / q2 : nan;
    }
}

}  // namespace

void Equirectangular::undistort_near(Vec2 m0, int k, double* x, double* y) const {
    PixelExpansion expansion{
        {inverse_[0] * scale_.x, inverse_[1] * scale_.y, inverse_[2] * scale_.x, inverse_[3] * scale_.y},
        m0,
        {},
        {},
        {},
        {},
        cube_face_};
    const double* A = expansion.to_angles;
    double farthest = 0;
    for (int i = 0; i < k; ++i) farthest = std::max({farthest, std::fabs(x[i] - m0.x), std::fabs(y[i] - m0.y)});
    const double step = farthest * std::max(std::fabs(A[0]) + std::fabs(A[1]), std::fabs(A[2]) + std::fabs(A[3]));
    if (!(step < small_step)) {
        constexpr double nan = std::numeric_limits<double>::quiet_NaN();
        for (int i = 0; i < k; ++i) {
            const Vec2 n = undistort({x[i], y[i]}).value_or(Vec2{nan, nan});
            x[i] = n.x, y[i] = n.y;
        }
        return;
    }
    const Vec2 a = angles_of_pixel({scale_.x * m0.x, scale_.y * m0.y});
    expansion.sine = {std::sin(a.x), std::sin(a.y)}, expansion.cosine = {std::cos(a.x), std::cos(a.y)};
    expansion.from = branch_.from - a, expansion.to = branch_.to - a;
    undistort_samples(expansion, k, x, y);
}

// A step in the angles rotates a direction by at most its length.
bool Equirectangular::may_show(Vec2 x, double reach) const {
    const Vec2 a = angles_of_pixel(x), from = branch_.from, to = branch_.to;
    const Vec2 step{(std::fabs(inverse_[0]) + std::fabs(inverse_[1])) * reach,
                    (std::fabs(inverse_[2]) + std::fabs(inverse_[3])) * reach};
    if (a.x + step.x < from.x || a.x - step.x > to.x || a.y + step.y < from.y || a.y - step.y > to.y) return false;
    return cube_face_.outside(direction_of(a)) <= 2 * length(step) + 1e-9;
}

Box2 Equirectangular::image_box(Box2 n) const {
    Box2 a = cube_face_.angles(n);
    a.low.x += M_PI * branch_.across, a.high.x += M_PI * branch_.across;
    const double shift = M_PI * branch_.over;
    const Vec2 y = branch_.over % 2 ? Vec2{shift - a.high.y, shift - a.low.y} : Vec2{shift + a.low.y, shift + a.high.y};
    Box2 out = Box2::empty();
    for (const double longitude : {a.low.x, a.high.x})
        for (const double latitude : {y.x, y.y})
            out.add({k_[0] * longitude + k_[1] * latitude + k_[2], k_[3] * longitude + k_[4] * latitude + k_[5]});
    return out;
}

Box2 Equirectangular::angles(const double* K, Box2 x) {
    const double det = K[0] * K[4] - K[1] * K[3];
    Box2 out = Box2::empty();
    for (const double px : {x.low.x, x.high.x})
        for (const double py : {x.low.y, x.high.y}) {
            const double dx = px - K[2], dy = py - K[5];
            out.add({(K[4] * dx - K[1] * dy) / det, (K[0] * dy - K[3] * dx) / det});
        }
    return out;
}

std::optional<Box2> Equirectangular::cube_face_box(Box2 x) const {
    constexpr double rounding = 1e-12;  // generous bound for angles
    const Box2 seen = angles(k_, x);
    // These are λ and φ of what is seen.
    Vec2 from{std::max(seen.low.x - M_PI * branch_.across, -M_PI), seen.low.y - M_PI * branch_.over};
    Vec2 to{std::min(seen.high.x - M_PI * branch_.across, M_PI), seen.high.y - M_PI * branch_.over};
    if (branch_.over % 2) std::swap(from.y, to.y), from.y = -from.y, to.y = -to.y;
    from = {from.x - rounding, std::max(from.y, -0.5 * M_PI) - rounding};
    to = {to.x + rounding, std::min(to.y, 0.5 * M_PI) + rounding};
    if (!(from.x < to.x && from.y < to.y)) return {};
    return cube_face_.box(from, to);
}

// The image draws parallels as long as the equator, stretched by 1 / cos φ. This is 1 / r next to a pole, and 2 / r in
// the mean over a disc around it.
double Equirectangular::stretch(Box2 n) const {
    if (!cube_face_.pole()) return 1;
    const double r = std::max(length(middle(n)), 0.5 * farthest_radius(n));
    return r > 0 ? std::sqrt(1 + 1 / (r * r)) : 1;
}

}  // namespace edgegrad
