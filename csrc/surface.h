// A ray meets a triangle: perspective-correct barycentrics, with their _vjp.
#pragma once

#include "camera.h"
#include "math.h"

namespace edgegrad {

// The point is (1 − u − v) q0 + u q1 + v q2.
struct Barycentrics {
    double u = 0, v = 0;

    double operator[](int corner) const { return corner == 0 ? 1 - u - v : corner == 1 ? u : v; }
};

// Möller and Trumbore 1997. With s = o − q0, P = d × e2, Q = s × e1, det = e1 · P: u = s · P / det, v = d · Q / det.
// Written with edges, not with positions seen from the eye, it loses only distance / size of the spacing of doubles.
// False where the triangle is seen exactly edge-on or has no area.
inline bool intersect(const Ray& ray, const Vec3 q[3], Barycentrics& b) {
    const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0], s = ray.origin - q[0];
    const Vec3 P = cross(ray.direction, e2), Q = cross(s, e1);
    const double inverse_det = 1.0 / dot(e1, P);
    b.u = dot(s, P) * inverse_det;
    b.v = dot(ray.direction, Q) * inverse_det;
    return std::isfinite(b.u) && std::isfinite(b.v);
}

inline void intersect_vjp(const Ray& ray, const Vec3 q[3], const Barycentrics& b, Barycentrics bar, Vec3 q_bar[3],
                          Ray& ray_bar) {
    const Vec3 e1 = q[1] - q[0], e2 = q[2] - q[0], s = ray.origin - q[0];
    const Vec3 P = cross(ray.direction, e2), Q = cross(s, e1);
    const double inverse_det = 1.0 / dot(e1, P);
    const double u_bar = bar.u * inverse_det, v_bar = bar.v * inverse_det, det_bar = -(b.u * u_bar + b.v * v_bar);
    Vec3 e1_bar, e2_bar, s_bar, P_bar, Q_bar;
    dot_vjp(s, P, u_bar, s_bar, P_bar);
    dot_vjp(ray.direction, Q, v_bar, ray_bar.direction, Q_bar);
    dot_vjp(e1, P, det_bar, e1_bar, P_bar);
    cross_vjp(ray.direction, e2, P_bar, ray_bar.direction, e2_bar);
    cross_vjp(s, e1, Q_bar, s_bar, e1_bar);
    ray_bar.origin += s_bar;
    q_bar[0] -= e1_bar + e2_bar + s_bar;
    q_bar[1] += e1_bar;
    q_bar[2] += e2_bar;
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

}  // namespace edgegrad
