// Where a face is seen: perspective-correct barycentrics as a function of the place in the image, with their _vjp.
#pragma once

#include <limits>

#include "camera/camera.h"
#include "core/math.h"

namespace edgegrad {

// The point is (1 − u − v) q0 + u q1 + v q2.
struct Barycentrics {
    double u = 0, v = 0;

    double operator[](int corner) const { return corner == 0 ? 1 - u - v : corner == 1 ? u : v; }
};

// The barycentrics of a face are a projective map of normalised image coordinates: with h = (n.x, n.y, 1),
//
//     (u w, v w, w) = M h.
//
// This is the test of Möller and Trumbore 1997, s = o − q0, u = s·(d × e2) / e1·(d × e2), v = d·(s × e1) / e1·(d × e2),
// with the ray taken out of the products, so that what belongs to the face is computed once for all of its samples.
// Written with edges, not with positions seen from the eye, it loses only distance / size of the spacing of doubles.
struct FaceMap {
    Vec3 column[3];  // of M

    Vec3 times(Vec2 n) const { return n.x * column[0] + n.y * column[1] + column[2]; }
};

inline FaceMap face_map(const Camera& camera, const Vec3 q[3]) {
    const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0], s = -q[0];
    Vec3 U{-e2.y, e2.x, s.y * e2.x - s.x * e2.y}, V{e1.y, -e1.x, s.x * e1.y - s.y * e1.x},
        D{0, 0, e2.x * e1.y - e2.y * e1.x};
    // In perspective o = 0 and d = h; in an orthographic view, above, o = (n.x, n.y, 0) and d = (0, 0, 1).
    if (camera.perspective) U = cross(e2, s), V = cross(s, e1), D = cross(e2, e1);
    return {{{U.x, V.x, D.x}, {U.y, V.y, D.y}, {U.z, V.z, D.z}}};
}

inline void face_map_vjp(const Camera& camera, const Vec3 q[3], const FaceMap& bar, Vec3 q_bar[3]) {
    const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0], s = -q[0], *c = bar.column;
    const Vec3 U{c[0].x, c[1].x, c[2].x}, V{c[0].y, c[1].y, c[2].y}, D{c[0].z, c[1].z, c[2].z};
    Vec3 e1_bar, e2_bar, s_bar;
    if (camera.perspective) {
        cross_vjp(e2, s, U, e2_bar, s_bar);
        cross_vjp(s, e1, V, s_bar, e1_bar);
        cross_vjp(e2, e1, D, e2_bar, e1_bar);
    } else {
        e2_bar = {U.y + s.y * U.z + e1.y * D.z, -U.x - s.x * U.z - e1.x * D.z, 0};
        e1_bar = {-V.y - s.y * V.z - e2.y * D.z, V.x + s.x * V.z + e2.x * D.z, 0};
        s_bar = {e1.y * V.z - e2.y * U.z, e2.x * U.z - e1.x * V.z, 0};
    }
    q_bar[0] -= e1_bar + e2_bar + s_bar;
    q_bar[1] += e1_bar;
    q_bar[2] += e2_bar;
}

inline FaceMap face_map_jvp(const Camera& camera, const Vec3 q[3], const Vec3 q_dot[3]) {
    const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0], s = -q[0];
    const Vec3 e1_dot = q_dot[1] - q_dot[0], e2_dot = q_dot[2] - q_dot[0], s_dot = -q_dot[0];
    const auto product = [](Vec3 a, Vec3 a_dot, Vec3 b, Vec3 b_dot) { return cross(a_dot, b) + cross(a, b_dot); };
    Vec3 U = product(e2, e2_dot, s, s_dot), V = product(s, s_dot, e1, e1_dot), D = product(e2, e2_dot, e1, e1_dot);
    if (!camera.perspective) U = {-e2_dot.y, e2_dot.x, U.z}, V = {e1_dot.y, -e1_dot.x, V.z}, D = {0, 0, D.z};
    return {{{U.x, V.x, D.x}, {U.y, V.y, D.y}, {U.z, V.z, D.z}}};
}

// False where the face is seen exactly edge-on or has no area.
inline bool barycentrics(const FaceMap& m, Vec2 n, Barycentrics& b) {
    const Vec3 p = m.times(n);
    const double inverse = 1.0 / p.z;
    b.u = p.x * inverse, b.v = p.y * inverse;
    return std::isfinite(b.u + b.v);
}

// Whether the plane of a face holds the eye of a perspective camera, as far as doubles can tell. It is then seen
// edge-on and covers nothing, though every ray meets the plane, in the eye.
inline bool passes_through_eye(const Vec3 q[3]) {
    const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0];
    return std::fabs(dot(q[0], cross(e1, e2))) <= rounding_of_triple_product(q[0], e1, e2);
}

// Whether the face covers n. One that doubles cannot tell from its rim does: between two faces that share an edge there
// must be no gap, and each computes that edge in its own way.
inline bool covers(const FaceMap& m, Vec2 n) {
    const Vec3 p = m.times(n);
    const double eps = 16 * std::numeric_limits<double>::epsilon(), x = eps * std::fabs(n.x), y = eps * std::fabs(n.y);
    const auto error = [&](double Vec3::* row) {
        return x * std::fabs(m.column[0].*row) + y * std::fabs(m.column[1].*row) + eps * std::fabs(m.column[2].*row);
    };
    const double eu = error(&Vec3::x), ev = error(&Vec3::y), ew = error(&Vec3::z), sign = p.z < 0 ? -1 : 1;
    return std::fabs(p.z) > ew && sign * p.x >= -eu && sign * p.y >= -ev && sign * (p.z - p.x - p.y) >= -(eu + ev + ew);
}

// δu = (δ(u w) − u δw) / w, and the same for v.
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

// Embree decides in float which triangle is hit, so the exact ray may pass just outside it. What was seen is the
// triangle's nearest rim: without this, a triangle seen almost edge-on would extrapolate its colours without bound.
inline Barycentrics inside(Barycentrics b) {
    b.u = b.u > 0 ? b.u : 0;
    b.v = b.v > 0 ? b.v : 0;
    const double sum = b.u + b.v;
    if (sum > 1) b.u /= sum, b.v /= sum;
    return b;
}

// Where a ray that hit the face was seen to hit it. Edge-on, any point will do.
inline Barycentrics barycentrics_of_hit(const FaceMap& m, Vec2 n) {
    Barycentrics b;
    const bool met = barycentrics(m, n, b);
    if (b.u >= 0 && b.v >= 0 && b.u + b.v <= 1) [[likely]]
        return b;
    return met ? inside(b) : Barycentrics{1.0 / 3, 1.0 / 3};
}

}  // namespace edgegrad
