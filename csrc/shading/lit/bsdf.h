// Evaluates BSDFs and their _vjp: Lambert's law f = base / π, and the metallic-roughness model of glTF 2.0 (appendix
// B). edgegrad/scene/material.py names its terms.
#pragma once

#include <algorithm>
#include <cmath>

#include "core/dual.h"
#include "shading/lit/tables.h"

namespace edgegrad {

constexpr double reflectance_of_dielectrics = 0.04, least_alpha = 1e-4;

template <class S>
struct Scattering {
    bool lambertian = true;
    S base[most_lit_channels], metallic = 0, roughness = 1;

    // Returns the diffuse albedo.
    S diffuse(int c) const { return lambertian ? base[c] : base[c] * (S(1) - metallic); }
    // Returns the specular reflectance at normal incidence, F0 of Schlick's approximation.
    S f0(int c) const { return S(reflectance_of_dielectrics) + (base[c] - S(reflectance_of_dielectrics)) * metallic; }
};
inline void diffuse_vjp(const Scattering<double>& s, int c, double bar, Scattering<double>& s_bar) {
    s_bar.base[c] += bar * (s.lambertian ? 1 : 1 - s.metallic);
    if (!s.lambertian) s_bar.metallic -= bar * s.base[c];
}

// Holds the lobe of microfacets for one pair of directions, and its factors.
template <class S>
struct Lobe {
    Vector<S> half, sine;
    S a2, nh, d, D;                    // α², n·h, |n × h|² + α² (n·h)², and the pdf of normals
    S nv, nl, towards, back, masking;  // Smith's term over 4 (n·v)(n·l), 1 / (2 (n·l towards + n·v back))
    S grazing, grazing5;               // (1 − v·h)⁵

    S specular() const { return D * masking; }
};
template <class S>
Lobe<S> lobe(S roughness, Vector<S> v, Vector<S> n, Vector<S> l) {
    Lobe<S> o;
    o.half = unit(v + l);
    const S squared = roughness * roughness;
    const S alpha = plain(squared) < least_alpha ? S(least_alpha) : squared;
    o.a2 = alpha * alpha;
    // Walter et al. 2007 define D. The sine comes from a cross product, as 1 − cos² would round away what a small α
    // needs.
    o.sine = cross(n, o.half), o.nh = dot(n, o.half);
    o.d = dot(o.sine, o.sine) + o.a2 * o.nh * o.nh;
    o.D = o.a2 / (S(M_PI) * o.d * o.d);
    // Heitz 2014, eq. 99, defines the masking.
    const S nv = dot(n, v);
    o.nv = plain(nv) < 0 ? S(0) : nv, o.nl = dot(n, l);
    o.towards = sqrt(o.a2 + (S(1) - o.a2) * o.nv * o.nv), o.back = sqrt(o.a2 + (S(1) - o.a2) * o.nl * o.nl);
    o.masking = S(0.5) / (o.nl * o.towards + o.nv * o.back);
    o.grazing = clamped(S(1) - dot(v, o.half), 0, 1);
    const S squared_grazing = o.grazing * o.grazing;
    o.grazing5 = squared_grazing * squared_grazing * o.grazing;
    return o;
}

// Writes the BSDF f(v, l) (channels,) in 1/sr. The unit vectors point to the viewer, along the normal, and to the
// light, which is above.
template <class S>
void scatter(const Scattering<S>& s, Vector<S> v, Vector<S> n, Vector<S> l, int channels, S* f) {
    if (s.lambertian) {
        for (int c = 0; c < channels; ++c) f[c] = S(1 / M_PI) * s.base[c];
        return;
    }
    const Lobe<S> o = lobe(s.roughness, v, n, l);
    const S specular = o.specular();
    for (int c = 0; c < channels; ++c) {
        const S f0 = s.f0(c);
        const S fresnel = f0 + (S(1) - f0) * o.grazing5;
        f[c] = (S(1) - fresnel) * S(1 / M_PI) * s.diffuse(c) + fresnel * specular;
    }
}

inline void scatter_vjp(const Scattering<double>& s, Vec3 v, Vec3 n, Vec3 l, int channels, const double* f_bar,
                        Scattering<double>& s_bar, Vec3& v_bar, Vec3& n_bar, Vec3& l_bar) {
    if (s.lambertian) {
        for (int c = 0; c < channels; ++c) s_bar.base[c] += f_bar[c] / M_PI;
        return;
    }
    const Lobe<double> o = lobe(s.roughness, v, n, l);
    const double specular = o.specular();
    double specular_bar = 0, grazing5_bar = 0;
    for (int c = 0; c < channels; ++c) {
        const double f0 = s.f0(c), fresnel = f0 + (1 - f0) * o.grazing5, diffuse = s.diffuse(c);
        specular_bar += f_bar[c] * fresnel;
        const double fresnel_bar = f_bar[c] * (specular - diffuse / M_PI);
        diffuse_vjp(s, c, f_bar[c] * (1 - fresnel) / M_PI, s_bar);
        const double f0_bar = fresnel_bar * (1 - o.grazing5);
        grazing5_bar += fresnel_bar * (1 - f0);
        s_bar.base[c] += f0_bar * s.metallic;
        s_bar.metallic += f0_bar * (s.base[c] - reflectance_of_dielectrics);
    }
    Vec3 half_bar;
    if (o.grazing > 0 && o.grazing < 1) {
        const double grazing4 = o.grazing5 / o.grazing;
        dot_vjp(v, o.half, -5 * grazing4 * grazing5_bar, v_bar, half_bar);
    }
    // The next lines differentiate D = α² / (π d²).
    const double D_bar = specular_bar * o.masking, masking_bar = specular_bar * o.D;
    double a2_bar = D_bar * o.D / o.a2;
    const double d_bar = -2 * D_bar * o.D / o.d;
    cross_vjp(n, o.half, 2 * d_bar * o.sine, n_bar, half_bar);
    a2_bar += d_bar * o.nh * o.nh;
    dot_vjp(n, o.half, 2 * d_bar * o.a2 * o.nh, n_bar, half_bar);
    // masking = 1 / (2 sum), sum = nl √(α² + (1 − α²) nv²) + nv √(α² + (1 − α²) nl²).
    const double sum_bar = -2 * masking_bar * o.masking * o.masking;
    const double towards2_bar = sum_bar * o.nl / (2 * o.towards), back2_bar = sum_bar * o.nv / (2 * o.back);
    a2_bar += towards2_bar * (1 - o.nv * o.nv) + back2_bar * (1 - o.nl * o.nl);
    const double nv_bar = sum_bar * o.back + 2 * towards2_bar * (1 - o.a2) * o.nv;
    const double nl_bar = sum_bar * o.towards + 2 * back2_bar * (1 - o.a2) * o.nl;
    if (o.nv > 0) dot_vjp(n, v, nv_bar, n_bar, v_bar);
    dot_vjp(n, l, nl_bar, n_bar, l_bar);
    // The next lines differentiate α² = roughness⁴.
    const double squared = s.roughness * s.roughness;
    if (squared >= least_alpha) s_bar.roughness += 4 * a2_bar * squared * s.roughness;
    const Vec3 sum_of_directions_bar = unit_vjp(v + l, half_bar);
    v_bar += sum_of_directions_bar, l_bar += sum_of_directions_bar;
}

// Fades light on an interpolated normal n to zero where it sets behind the face, whose normal is g. Both normals are on
// the light's side (Chiang, Li and Burley 2019, "Taming the Shadow Terminator").
constexpr double least_gn = 1e-6, least_nl = 1e-12;
template <class S>
S at_least(S a, double low) {
    return plain(a) < low ? S(low) : a;
}
template <class S>
S terminator(Vector<S> g, Vector<S> n, Vector<S> l) {
    const S G = clamped(dot(g, l) / (at_least(dot(g, n), least_gn) * at_least(dot(n, l), least_nl)), 0, 1);
    return G + G * G - G * G * G;
}
inline void terminator_vjp(Vec3 g, Vec3 n, Vec3 l, double bar, Vec3& g_bar, Vec3& n_bar, Vec3& l_bar) {
    const double gl = dot(g, l), gn = at_least(dot(g, n), least_gn), nl = at_least(dot(n, l), least_nl);
    const double G = gl / (gn * nl);
    if (!(G > 0 && G < 1)) return;
    const double G_bar = bar * (1 + 2 * G - 3 * G * G);
    dot_vjp(g, l, G_bar / (gn * nl), g_bar, l_bar);
    if (dot(g, n) > least_gn) dot_vjp(g, n, -G_bar * G / gn, g_bar, n_bar);
    if (dot(n, l) > least_nl) dot_vjp(n, l, -G_bar * G / nl, n_bar, l_bar);
}

}  // namespace edgegrad
