#include "camera/equirectangular.h"

#include <algorithm>

namespace edgegrad {

namespace {

Vec3 direction_of(Vec2 angles) {
    const double c = std::cos(angles.y);
    return {c * std::sin(angles.x), std::sin(angles.y), c * std::cos(angles.x)};
}

void add(Box2& box, Vec2 p) {
    box.low = {std::min(box.low.x, p.x), std::min(box.low.y, p.y)};
    box.high = {std::max(box.high.x, p.x), std::max(box.high.y, p.y)};
}

// Of the point of a box that is nearest to the origin, and of the corner that is farthest from it.
double nearest_radius(Box2 b) {
    return length(Vec2{std::clamp(0.0, b.low.x, b.high.x), std::clamp(0.0, b.low.y, b.high.y)});
}
double farthest_radius(Box2 b) { return length(Vec2{std::max(-b.low.x, b.high.x), std::max(-b.low.y, b.high.y)}); }

Vec2 middle(Box2 b) { return 0.5 * (b.low + b.high); }

}  // namespace

Equirectangular::Equirectangular(const double* K, const Side& side, const Place& place) : side_(side), place_(place) {
    std::copy(K, K + 6, k_);
    const double det = k_[0] * k_[4] - k_[1] * k_[3], size = std::sqrt(std::fabs(det));
    inverse_[0] = k_[4] / det, inverse_[1] = -k_[1] / det, inverse_[2] = -k_[3] / det, inverse_[3] = k_[0] / det;
    // Over a pole the image is mirrored.
    scale_ = {size, (det < 0) != (place.over % 2 != 0) ? -size : size};
}

Vec2 Equirectangular::angles_at(Vec3 d) const {
    const double latitude = std::atan2(d.y, std::sqrt(d.x * d.x + d.z * d.z));
    return {std::atan2(d.x, d.z) + M_PI * place_.across,
            place_.over % 2 ? M_PI * place_.over - latitude : M_PI * place_.over + latitude};
}

Vec2 Equirectangular::angles_of_pixel(Vec2 x) const {
    const double dx = x.x - k_[2], dy = x.y - k_[5];
    return {inverse_[0] * dx + inverse_[1] * dy, inverse_[2] * dx + inverse_[3] * dy};
}

Vec2 Equirectangular::bend(Vec2 n) const {
    const Vec2 a = angles_at(direction(n));
    return {(k_[0] * a.x + k_[1] * a.y + k_[2]) / scale_.x, (k_[3] * a.x + k_[4] * a.y + k_[5]) / scale_.y};
}

// ∂λ/∂d = (d.z, 0, −d.x) / h² and ∂φ/∂d = (−d.y d.x / h, h, −d.y d.z / h) / |d|². At the pole itself, where there is
// none, zero.
Mat2 Equirectangular::jacobian(Vec2 n) const {
    const Vec3 d = direction(n);
    const double h2 = d.x * d.x + d.z * d.z, h = std::sqrt(h2), all = h2 + d.y * d.y;
    if (!(h2 > 0)) return {0, 0, 0, 0};
    const double sign = place_.over % 2 ? -1 : 1;
    const Vec3 longitude = (1 / h2) * Vec3{d.z, 0, -d.x},
               latitude = (sign / all) * Vec3{-d.y * d.x / h, h, -d.y * d.z / h};
    const Vec3 along[2] = {side_.turn.row[0], side_.turn.row[1]};  // ∂d/∂n
    double a[2][2];
    for (int i = 0; i < 2; ++i) a[0][i] = dot(longitude, along[i]), a[1][i] = dot(latitude, along[i]);
    const auto row = [&](int r, int i) { return k_[3 * r] * a[0][i] + k_[3 * r + 1] * a[1][i]; };
    return {row(0, 0) / scale_.x, row(0, 1) / scale_.x, row(1, 0) / scale_.y, row(1, 1) / scale_.y};
}

void Equirectangular::bend_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* k_bar) const {
    n_bar += transposed_times(jacobian(n), bar);
    const Vec2 a = angles_at(direction(n));
    const double x = bar.x / scale_.x, y = bar.y / scale_.y;
    k_bar[0] += x * a.x, k_bar[1] += x * a.y, k_bar[2] += x;
    k_bar[3] += y * a.x, k_bar[4] += y * a.y, k_bar[5] += y;
}

// Of two sides that share a border each computes the same numbers, but for their signs: so every direction has one.
std::optional<Vec2> Equirectangular::straighten(Vec2 m) const {
    const Vec2 a = angles_of_pixel({scale_.x * m.x, scale_.y * m.y}), from = place_.from, to = place_.to;
    if (!(a.x >= from.x && a.x < to.x && a.y >= from.y && a.y < to.y)) return {};
    const Vec3 q = side_.turn * direction_of(a);
    const bool inside = side_.closed ? std::fabs(q.x) <= q.z && std::fabs(q.y) <= q.z
                                     : q.x >= -q.z && q.x < q.z && std::fabs(q.y) < q.z;
    if (!(inside && q.z > 0)) return {};
    return Vec2{q.x / q.z, q.y / q.z};
}

// A step in the angles turns a direction by no more than its length.
bool Equirectangular::may_show(Vec2 x, double reach) const {
    const Vec2 a = angles_of_pixel(x), from = place_.from, to = place_.to;
    const Vec2 step{(std::fabs(inverse_[0]) + std::fabs(inverse_[1])) * reach,
                    (std::fabs(inverse_[2]) + std::fabs(inverse_[3])) * reach};
    if (a.x + step.x < from.x || a.x - step.x > to.x || a.y + step.y < from.y || a.y - step.y > to.y) return false;
    const Vec3 q = side_.turn * direction_of(a);
    return std::max(std::fabs(q.x), std::fabs(q.y)) - q.z <= 2 * length(step) + 1e-9;
}

// λ and φ over a box of n.
Box2 Equirectangular::base_box(Box2 n) const {
    const Vec2 low = n.low, high = n.high;
    if (!side_.pole()) {
        const double nearest = std::clamp(0.0, low.x, high.x), farthest = std::max(-low.x, high.x);
        const auto latitude = [&](double x, double y) { return std::atan(y / std::sqrt(1 + x * x)); };
        Box2 out{{std::atan(low.x), latitude(low.y <= 0 ? nearest : farthest, low.y)},
                 {std::atan(high.x), latitude(high.y >= 0 ? nearest : farthest, high.y)}};
        const double ahead = std::atan2(side_.turn.row[2].x, side_.turn.row[2].z);
        out.low.x += ahead, out.high.x += ahead;
        if (out.low.x >= M_PI) out.low.x -= 2 * M_PI, out.high.x -= 2 * M_PI;
        if (out.high.x > M_PI) out.low.x = -M_PI, out.high.x = M_PI;  // on both sides of the seam
        return out;
    }
    const double sign = side_.turn.row[2].y, nearest = nearest_radius(n), farthest = farthest_radius(n);
    Box2 out{{-M_PI, 0}, {M_PI, 0}};
    const double outer = 0.5 * M_PI - std::atan(farthest), inner = 0.5 * M_PI - std::atan(nearest);
    out.low.y = sign > 0 ? outer : -inner, out.high.y = sign > 0 ? inner : -outer;
    // Whether it reaches to the pole or over the seam, where d.x = 0 and d.z ≤ 0; d.z = −sign n.y.
    if (low.x <= 0 && high.x >= 0 && (sign > 0 ? high.y >= 0 : low.y <= 0)) return out;
    out.low.x = infinite, out.high.x = -infinite;
    for (const Vec2 corner : {low, {high.x, low.y}, high, {low.x, high.y}}) {
        const double longitude = std::atan2(corner.x, -sign * corner.y);
        out.low.x = std::min(out.low.x, longitude), out.high.x = std::max(out.high.x, longitude);
    }
    return out;
}

Box2 Equirectangular::image_box(Box2 n) const {
    Box2 a = base_box(n);
    a.low.x += M_PI * place_.across, a.high.x += M_PI * place_.across;
    const double shift = M_PI * place_.over;
    const Vec2 y = place_.over % 2 ? Vec2{shift - a.high.y, shift - a.low.y} : Vec2{shift + a.low.y, shift + a.high.y};
    Box2 out{{infinite, infinite}, {-infinite, -infinite}};
    for (const double longitude : {a.low.x, a.high.x})
        for (const double latitude : {y.x, y.y})
            add(out, {k_[0] * longitude + k_[1] * latitude + k_[2], k_[3] * longitude + k_[4] * latitude + k_[5]});
    return out;
}

Box2 Equirectangular::angles(const double* K, Box2 x) {
    const double det = K[0] * K[4] - K[1] * K[3];
    Box2 out{{infinite, infinite}, {-infinite, -infinite}};
    for (const double px : {x.low.x, x.high.x})
        for (const double py : {x.low.y, x.high.y}) {
            const double dx = px - K[2], dy = py - K[5];
            add(out, {(K[4] * dx - K[1] * dy) / det, (K[0] * dy - K[3] * dx) / det});
        }
    return out;
}

std::optional<Box2> Equirectangular::side_box(Box2 x) const {
    constexpr double rounding = 1e-12;  // of angles, generous
    const Box2 seen = angles(k_, x);
    // λ and φ of what is seen.
    Vec2 from{std::max(seen.low.x - M_PI * place_.across, -M_PI), seen.low.y - M_PI * place_.over};
    Vec2 to{std::min(seen.high.x - M_PI * place_.across, M_PI), seen.high.y - M_PI * place_.over};
    if (place_.over % 2) std::swap(from.y, to.y), from.y = -from.y, to.y = -to.y;
    from = {from.x - rounding, std::max(from.y, -0.5 * M_PI) - rounding};
    to = {to.x + rounding, std::min(to.y, 0.5 * M_PI) + rounding};
    if (!(from.x < to.x && from.y < to.y)) return {};
    Box2 out{{infinite, infinite}, {-infinite, -infinite}};
    const auto slope = [](double angle) {
        return angle >= 0.5 * M_PI ? infinite : angle <= -0.5 * M_PI ? -infinite : std::tan(angle);
    };
    if (!side_.pole()) {
        const double ahead = std::atan2(side_.turn.row[2].x, side_.turn.row[2].z);
        for (const double turn : {0.0, 2 * M_PI}) {  // what lies behind is seen at both ends
            const double low = std::max(from.x - ahead + turn, -0.25 * M_PI),
                         high = std::min(to.x - ahead + turn, 0.25 * M_PI);
            if (!(low < high)) continue;
            const double a = std::tan(low), b = std::tan(high), nearest = std::clamp(0.0, a, b),
                         farthest = std::max(-a, b);
            const auto y = [&](double s, bool outwards) {
                const double at = outwards ? farthest : nearest;
                return s * std::sqrt(1 + at * at);
            };
            const double lowest = slope(from.y), highest = slope(to.y);
            add(out, {a, y(lowest, lowest < 0)}), add(out, {b, y(highest, highest > 0)});
        }
    } else {
        const double sign = side_.turn.row[2].y;
        // Distances from the pole.
        const double near = 0.5 * M_PI - (sign > 0 ? to.y : -from.y), far = 0.5 * M_PI - (sign > 0 ? from.y : -to.y);
        const double inner = std::max(0.0, slope(near)), outer = std::min(slope(far), 2.0);
        if (!(inner < outer)) return {};
        const auto at = [&](double r, double longitude) {
            add(out, {r * std::sin(longitude), -sign * r * std::cos(longitude)});
        };
        for (const double r : {inner, outer}) at(r, from.x), at(r, to.x);
        for (int i = -4; i <= 4; ++i)
            if (const double axis = 0.5 * M_PI * i; axis > from.x && axis < to.x) at(outer, axis);
    }
    // Widened by the rounding of these functions.
    out.low = {std::max(out.low.x - rounding, -1.0), std::max(out.low.y - rounding, -1.0)};
    out.high = {std::min(out.high.x + rounding, 1.0), std::min(out.high.y + rounding, 1.0)};
    if (!(out.low.x < out.high.x && out.low.y < out.high.y)) return {};
    return out;
}

// Parallels are drawn as long as the equator: 1 / cos φ, which is 1 / r next to a pole, and 2 / r in the mean over a
// disc around it.
double Equirectangular::stretch(Box2 n) const {
    if (!side_.pole()) return 1;
    const double r = std::max(length(middle(n)), 0.5 * farthest_radius(n));
    return r > 0 ? std::sqrt(1 + 1 / (r * r)) : 1;
}

}  // namespace edgegrad
