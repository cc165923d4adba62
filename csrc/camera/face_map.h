// Computes perspective-correct barycentrics of a face as a function of the image position, and their _vjp.
#pragma once

#include <limits>

#include "camera/camera.h"
#include "core/math.h"

namespace edgegrad {

// Refers to the point (1 − u − v) q0 + u q1 + v q2.
struct Barycentrics {
    double u = 0, v = 0;

    double operator[](int corner) const { return corner == 0 ? 1 - u - v : corner == 1 ? u : v; }
};

inline FaceMap face_map(const Camera& camera, const Vec3 q[3]) {
    const FaceSides sides{q[1] - q[0], q[2] - q[0], -q[0]};
    const auto [U, V, D] = camera.projection([&](auto p) { return p.face_rows(sides); });
    return {{{U.x, V.x, D.x}, {U.y, V.y, D.y}, {U.z, V.z, D.z}}};
}

inline void face_map_vjp(const Camera& camera, const Vec3 q[3], const FaceMap& bar, Vec3 q_bar[3]) {
    const FaceSides sides{q[1] - q[0], q[2] - q[0], -q[0]};
    const FaceRows rows_bar{bar.row(&Vec3::x), bar.row(&Vec3::y), bar.row(&Vec3::z)};
    FaceSides sides_bar;
    camera.projection([&](auto p) { p.face_rows_vjp(sides, rows_bar, sides_bar); });
    q_bar[0] -= sides_bar.e1 + sides_bar.e2 + sides_bar.s;
    q_bar[1] += sides_bar.e1;
    q_bar[2] += sides_bar.e2;
}

inline FaceMap face_map_jvp(const Camera& camera, const Vec3 q[3], const Vec3 q_dot[3]) {
    const FaceSides sides{q[1] - q[0], q[2] - q[0], -q[0]};
    const FaceSides sides_dot{q_dot[1] - q_dot[0], q_dot[2] - q_dot[0], -q_dot[0]};
    const auto [U, V, D] = camera.projection([&](auto p) { return p.face_rows_jvp(sides, sides_dot); });
    return {{{U.x, V.x, D.x}, {U.y, V.y, D.y}, {U.z, V.z, D.z}}};
}

// Returns false where the face is exactly edge-on or has no area.
inline bool barycentrics(const FaceMap& m, Vec2 n, Barycentrics& b) {
    const Vec3 p = m.times(n);
    const double inverse = 1.0 / p.z;
    b.u = p.x * inverse, b.v = p.y * inverse;
    return std::isfinite(b.u + b.v);
}

// Returns whether the face covers n. Points that doubles cannot distinguish from its boundary count as covered.
// Otherwise there might be gaps between adjacent faces, which compute their shared edge differently.
inline bool covers(const FaceMap& m, Vec2 n) {
    const Vec3 p = m.times(n);
    const double eps = 16 * std::numeric_limits<double>::epsilon(), x = eps * std::fabs(n.x), y = eps * std::fabs(n.y);
    const auto error = [&](double Vec3::* row) {
        return x * std::fabs(m.column[0].*row) + y * std::fabs(m.column[1].*row) + eps * std::fabs(m.column[2].*row);
    };
    const double eu = error(&Vec3::x), ev = error(&Vec3::y), ew = error(&Vec3::z), sign = p.z < 0 ? -1 : 1;
    return std::fabs(p.z) > ew && sign * p.x >= -eu && sign * p.y >= -ev && sign * (p.z - p.x - p.y) >= -(eu + ev + ew);
}

// Uses δu = (δ(u w) − u δw) / w, and the same for v.
inline void barycentrics_vjp(const FaceMap& m, Vec2 n, Barycentrics b, Barycentrics bar, FaceMap& m_bar, Vec2& n_bar) {
    const double inverse = 1.0 / m.times(n).z;
    const Vec3 p_bar{bar.u * inverse, bar.v * inverse, -(b.u * bar.u + b.v * bar.v) * inverse};
    m_bar.column[0] += n.x * p_bar, m_bar.column[1] += n.y * p_bar, m_bar.column[2] += p_bar;
    n_bar += Vec2{dot(p_bar, m.column[0]), dot(p_bar, m.column[1])};
}

inline Barycentrics barycentrics_jvp(const FaceMap& m, Vec2 n, Barycentrics b, const FaceMap& m_dot, Vec2 n_dot) {
    const double inverse = 1.0 / m.times(n).z;
    const Vec3 p_dot = m_dot.times(n) + n_dot.x * m.column[0] + n_dot.y * m.column[1];
    return {(p_dot.x - b.u * p_dot.z) * inverse, (p_dot.y - b.v * p_dot.z) * inverse};
}

// Returns the nearest boundary point, if b lies outside. Embree decides hits in float, so the exact ray may pass just
// outside the triangle. Otherwise an almost edge-on triangle would extrapolate its colours without bound.
inline Barycentrics inside(Barycentrics b) {
    b.u = b.u > 0 ? b.u : 0;
    b.v = b.v > 0 ? b.v : 0;
    const double sum = b.u + b.v;
    if (sum > 1) b.u /= sum, b.v /= sum;
    return b;
}

// Returns the barycentrics of a ray's hit. Edge-on, any point will do.
inline Barycentrics barycentrics_of_hit(const FaceMap& m, Vec2 n) {
    Barycentrics b;
    const bool met = barycentrics(m, n, b);
    if (b.u >= 0 && b.v >= 0 && b.u + b.v <= 1) [[likely]]
        return b;
    return met ? inside(b) : Barycentrics{1.0 / 3, 1.0 / 3};
}

}  // namespace edgegrad
