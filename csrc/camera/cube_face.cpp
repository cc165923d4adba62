#include "camera/cube_face.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

constexpr double infinite = std::numeric_limits<double>::infinity();

double nearest_radius(Box2 b) {
    return length(Vec2{std::clamp(0.0, b.low.x, b.high.x), std::clamp(0.0, b.low.y, b.high.y)});
}

}  // namespace

void Box2::add(Vec2 p) {
    low = {std::min(low.x, p.x), std::min(low.y, p.y)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y)};
}

double farthest_radius(Box2 b) { return length(Vec2{std::max(-b.low.x, b.high.x), std::max(-b.low.y, b.high.y)}); }

Vec2 middle(Box2 b) { return 0.5 * (b.low + b.high); }

Box2 sector_box(double inner, double outer, double from, double to) {
    Box2 out = Box2::empty();
    const auto add = [&](double r, double angle) { out.add({r * std::sin(angle), r * std::cos(angle)}); };
    for (const double r : {inner, outer}) add(r, from), add(r, to);
    for (int i = -4; i <= 4; ++i)
        if (const double axis = 0.5 * M_PI * i; axis > from && axis < to) add(outer, axis);
    return out;
}

// Two faces that share a border compute the same numbers, except for signs, so every direction has one face.
std::optional<Vec2> CubeFace::place(Vec3 d) const {
    const Vec3 q = rotation * d;
    const bool inside =
        closed ? std::fabs(q.x) <= q.z && std::fabs(q.y) <= q.z : q.x >= -q.z && q.x < q.z && std::fabs(q.y) < q.z;
    if (!(inside && q.z > 0)) return {};
    return Vec2{q.x / q.z, q.y / q.z};
}

double CubeFace::outside(Vec3 d) const {
    const Vec3 q = rotation * d;
    return std::max(std::fabs(q.x), std::fabs(q.y)) - q.z;
}

Box2 CubeFace::angles(Box2 n) const {
    const Vec2 low = n.low, high = n.high;
    if (!pole()) {
        const double nearest = std::clamp(0.0, low.x, high.x), farthest = std::max(-low.x, high.x);
        const auto latitude = [&](double x, double y) { return std::atan(y / std::sqrt(1 + x * x)); };
        Box2 out{{std::atan(low.x), latitude(low.y <= 0 ? nearest : farthest, low.y)},
                 {std::atan(high.x), latitude(high.y >= 0 ? nearest : farthest, high.y)}};
        const double ahead = std::atan2(rotation.row[2].x, rotation.row[2].z);
        out.low.x += ahead, out.high.x += ahead;
        if (out.low.x >= M_PI) out.low.x -= 2 * M_PI, out.high.x -= 2 * M_PI;
        if (out.high.x > M_PI) out.low.x = -M_PI, out.high.x = M_PI;  // It lies on both sides of the seam.
        return out;
    }
    const double sign = rotation.row[2].y, nearest = nearest_radius(n), farthest = farthest_radius(n);
    Box2 out{{-M_PI, 0}, {M_PI, 0}};
    const double outer = 0.5 * M_PI - std::atan(farthest), inner = 0.5 * M_PI - std::atan(nearest);
    out.low.y = sign > 0 ? outer : -inner, out.high.y = sign > 0 ? inner : -outer;
    // The box may reach to the pole or over the seam, where d.x = 0 and d.z ≤ 0; d.z = −sign n.y.
    if (low.x <= 0 && high.x >= 0 && (sign > 0 ? high.y >= 0 : low.y <= 0)) return out;
    out.low.x = infinite, out.high.x = -infinite;
    for (const Vec2 corner : {low, {high.x, low.y}, high, {low.x, high.y}}) {
        const double longitude = std::atan2(corner.x, -sign * corner.y);
        out.low.x = std::min(out.low.x, longitude), out.high.x = std::max(out.high.x, longitude);
    }
    return out;
}

std::optional<Box2> CubeFace::box(Vec2 from, Vec2 to) const {
    constexpr double rounding = 1e-12;  // generous
    Box2 out = Box2::empty();
    const auto slope = [](double angle) {
        return angle >= 0.5 * M_PI ? infinite : angle <= -0.5 * M_PI ? -infinite : std::tan(angle);
    };
    if (!pole()) {
        const double ahead = std::atan2(rotation.row[2].x, rotation.row[2].z);
        for (const double around : {0.0, 2 * M_PI}) {  // The face behind is seen at both ends.
            const double low = std::max(from.x - ahead + around, -0.25 * M_PI),
                         high = std::min(to.x - ahead + around, 0.25 * M_PI);
            if (!(low < high)) continue;
            const double a = std::tan(low), b = std::tan(high), nearest = std::clamp(0.0, a, b),
                         farthest = std::max(-a, b);
            const auto y = [&](double s, bool outwards) {
                const double at = outwards ? farthest : nearest;
                return s * std::sqrt(1 + at * at);
            };
            const double lowest = slope(from.y), highest = slope(to.y);
            out.add({a, y(lowest, lowest < 0)}), out.add({b, y(highest, highest > 0)});
        }
    } else {
        const double sign = rotation.row[2].y;
        // These are distances from the pole.
        const double near = 0.5 * M_PI - (sign > 0 ? to.y : -from.y), far = 0.5 * M_PI - (sign > 0 ? from.y : -to.y);
        const double inner = std::max(0.0, slope(near)), outer = std::min(slope(far), 2.0);
        if (!(inner < outer)) return {};
        out = sector_box(inner, outer, from.x, to.x);
        if (sign > 0) out = {{out.low.x, -out.high.y}, {out.high.x, -out.low.y}};
    }
    // The box is widened by the rounding of these functions.
    out.low = {std::max(out.low.x - rounding, -1.0), std::max(out.low.y - rounding, -1.0)};
    out.high = {std::min(out.high.x + rounding, 1.0), std::min(out.high.y + rounding, 1.0)};
    if (!(out.low.x < out.high.x && out.low.y < out.high.y)) return {};
    return out;
}

}  // namespace edgegrad
