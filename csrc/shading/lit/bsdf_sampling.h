// Samples directions by the BSDF of a glossy surface: the view direction, mirrored at microfacet normals that the
// viewer sees. pdfs are with respect to solid angle.
#pragma once

#include <algorithm>
#include <cmath>

#include "core/math.h"
#include "shading/lit/lit_surface.h"

namespace edgegrad {

// A rougher lobe is so wide that sampling it only costs time.
constexpr double widest_lobe = 0.65;

// Returns two unit vectors across n, and n (Duff et al. 2017, "Building an orthonormal basis, revisited").
inline Mat3 axes_around(Vec3 n) {
    const double sign = std::copysign(1.0, n.z), a = -1 / (sign + n.z), b = n.x * n.y * a;
    return {{{1 + sign * n.x * n.x * a, sign * b, -sign * n.x}, {b, sign + n.y * n.y * a, -n.y}, n}};
}

// Returns a direction above n with the pdf n·l / π, from numbers in [0, 1).
inline Vec3 draw_by_cosine(Vec3 n, Vec2 u) {
    const double across = std::sqrt(u.y), phi = 2 * M_PI * u.x;
    return transposed_times(axes_around(n), {across * std::cos(phi), across * std::sin(phi), std::sqrt(1 - u.y)});
}

// Samples the lobe of one point, without derivatives.
class DrawnLobe {
   public:
    template <class S>
    explicit DrawnLobe(const Surface<S>& o) : n_(plain(o.n)) {
        const double roughness = plain(o.scattering.roughness);
        if (o.scattering.lambertian || roughness > widest_lobe) return;
        *this = DrawnLobe(n_, plain(o.v), std::max(roughness * roughness, least_alpha));
    }
    // Builds the lobe from a normal, a unit direction to the viewer, and the roughness squared.
    DrawnLobe(Vec3 n, Vec3 v, double alpha) : alpha_(alpha), n_(n) {
        // An interpolated normal may be turned away from the viewer; the lobe at the horizon serves then.
        const double nv = dot(n_, v);
        v_ = nv >= 0 ? v : unit(v - nv * n_);
        nv_ = std::max(nv, 0.0);
        // The bound limits normals to the cap whose mirrored directions are above the surface (Tokuyoshi and Eto 2024,
        // "Bounded VNDF sampling for the Smith-GGX BRDF", eq. 6).
        const double a2 = alpha_ * alpha_, s = 1 + std::sqrt(std::max(0.0, 1 - nv_ * nv_));
        bound_ = (1 - a2) * s * s / (s * s + a2 * nv_ * nv_);
    }

    bool exists() const { return alpha_ > 0; }

    // Returns the direction in which a flat mirror would look.
    Vec3 mirrored() const { return unit(2 * nv_ * n_ - v_); }
    // Returns one over the pdf in the mirror direction, and at most the hemisphere.
    double solid_angle() const {
        return exists() ? std::min(2 * M_PI * alpha_ * alpha_ * spread(), 2 * M_PI) : 2 * M_PI;
    }

    // Returns the pdf with respect to solid angle: D(h) / 2 (k n·v + √(α² + (1 − α²) (n·v)²)), with the bound k.
    double pdf(Vec3 l) const {
        const Vec3 h = unit(v_ + l), sine = cross(n_, h);
        const double a2 = alpha_ * alpha_, nh = dot(n_, h), d = dot(sine, sine) + a2 * nh * nh;
        return a2 / (M_PI * d * d) / (2 * spread());
    }

    // Returns a direction from numbers in [0, 1). Where the hemisphere of normals is a sphere, its points fill a cap
    // evenly (Dupuy and Benyoub 2023, "Sampling visible GGX normals with spherical caps").
    Vec3 draw(double u1, double u2) const {
        const Mat3 axes = axes_around(n_);
        const Vec3 own = axes * v_, wide = unit({alpha_ * own.x, alpha_ * own.y, std::max(own.z, 0.0)});
        const double b = bound_ * wide.z, z = (1 - u2) * (1 + b) - b, phi = 2 * M_PI * u1;
        const double across = std::sqrt(std::clamp(1 - z * z, 0.0, 1.0));
        const Vec3 m = Vec3{across * std::cos(phi), across * std::sin(phi), z} + wide;
        const Vec3 h = transposed_times(axes, unit({alpha_ * m.x, alpha_ * m.y, m.z}));
        return unit(2 * dot(v_, h) * h - v_);
    }

   private:
    double spread() const {
        const double a2 = alpha_ * alpha_;
        return bound_ * nv_ + std::sqrt(a2 + (1 - a2) * nv_ * nv_);
    }

    double alpha_ = 0, nv_ = 0, bound_ = 1;
    Vec3 v_, n_;
};

}  // namespace edgegrad
