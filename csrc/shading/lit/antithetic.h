// Completes directions to antithetic sets, in which positive and negative parts of a glossy lobe's derivatives cancel.
#pragma once

#include <algorithm>
#include <cmath>

#include "core/math.h"

namespace edgegrad {

// Holds a direction l to a light and its antithetic partners. The half vector h = unit(v + l) lies at the angle θ from
// the normal n. The partners have h rotated by π about n, h at the angle θ' with tan θ tan θ' = α², and both.
//
// The derivative of the normal distribution D with respect to n changes its sign with the rotation by π. The derivative
// with respect to α is negative for tan θ < α and positive beyond. Both parts have the same mass 1/(2α), and the same
// distribution of u = 4 α² t / (α² + t)², t = tan² θ. Two angles have the same u (signed pairs: Zhang, Dong, Doggett
// and Zhao 2021; Belhe et al. 2024). Both maps are their own inverse, and they commute, so normals fall into antithetic
// sets. A set has the pdf Σ p(h_k) |dh_k / dh|, whichever of its four members is drawn.
struct AntitheticSet {
    static constexpr int most = 4;
    int count = 1;
    Vec3 l[most];
    double measure[most] = {1};  // solid angle of each direction, over that of the first one's normal

    AntitheticSet(Vec3 v, Vec3 n, double alpha, Vec3 first) : l{first} {
        const Vec3 h = unit(v + first), sine = cross(n, h);
        const double cosine = dot(n, h), t = dot(sine, sine) / (cosine * cosine);
        if (!(cosine > 0 && t > least_tangent2)) return;  // The first normal is turned away, or in the lobe's centre.
        count = most;
        const Vec3 along = cosine * n, across = h - along;
        // dω = ½ cos³ θ dt dφ
        const double ratio = alpha * alpha / t, other = 1 / std::sqrt(1 + ratio * ratio * t), c = other / cosine;
        const double other_measure = c * c * c * ratio * ratio;
        set(0, v, h, 1), set(1, v, along - across, 1), l[0] = first;
        set(2, v, other * n + ratio * c * across, other_measure);
        set(3, v, other * n - ratio * c * across, other_measure);
    }

   private:
    static constexpr double least_tangent2 = 1e-24;  // A smaller tangent has no azimuth in doubles.

    // Uses dω_l = 4 (v·h) dω_h. Where v·h < 0, no direction has this normal.
    void set(int k, Vec3 v, Vec3 h, double share) {
        const double vh = dot(v, h);
        l[k] = unit(2 * vh * h - v), measure[k] = 4 * share * std::max(vh, 0.0);
    }
};

}  // namespace edgegrad
