// Evaluates the radiance at a point whose visible lights are known, and its _vjp.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "shading/lit/light_sample.h"
#include "shading/lit/spherical_harmonics.h"

namespace edgegrad {

// Adds what a surface sends by itself: its emission, or its colour if it has no material.
template <class S>
void add_own_radiance(const LitScene& lit, const Surface<S>& o, S* total) {
    if (!o.mesh->has_material) {
        for (int c = 0; c < lit.channels; ++c) total[c] += o.scattering.base[c];
    } else if (o.mesh->emission.exists()) {
        S own[most_lit_channels];
        value(lit.tables, o.mesh->emission, o.at, lit.channels, own);
        for (int c = 0; c < lit.channels; ++c) total[c] += own[c];
    }
}
inline void add_own_radiance_vjp(const LitScene& lit, const Surface<double>& o, const double* total_bar,
                                 SurfaceBar& bar, Cotangents& to) {
    if (!o.mesh->has_material) {
        for (int c = 0; c < lit.channels; ++c) bar.scattering.base[c] += total_bar[c];
    } else if (o.mesh->emission.exists()) {
        value_vjp(lit.tables, o.mesh->emission, o.at, lit.channels, total_bar, bar.at, to);
    }
}

// Adds the scattered light of lights that cast no shadows.
template <class S>
void add_unshadowed(const LitScene& lit, const Surface<S>& o, S* total) {
    if (!o.mesh->has_material) return;
    S E[most_lit_channels];
    for (const Light& light : lit.lights) {
        if (light.casts()) continue;
        irradiance<S>(lit.tables, light, lit.channels, o.n, E);
        for (int c = 0; c < lit.channels; ++c) total[c] += S(1 / M_PI) * o.scattering.diffuse(c) * E[c];
    }
}
inline void add_unshadowed_vjp(const LitScene& lit, const Surface<double>& o, const double* total_bar, SurfaceBar& bar,
                               Cotangents& to) {
    if (!o.mesh->has_material) return;
    double E[most_lit_channels], E_bar[most_lit_channels];
    for (const Light& light : lit.lights) {
        if (light.casts()) continue;
        irradiance<double>(lit.tables, light, lit.channels, o.n, E);
        for (int c = 0; c < lit.channels; ++c) {
            E_bar[c] = total_bar[c] / M_PI * o.scattering.diffuse(c);
            diffuse_vjp(o.scattering, c, total_bar[c] / M_PI * E[c], bar.scattering);
        }
        irradiance_vjp(lit.tables, light, lit.channels, o.n, E_bar, bar.n, to);
    }
}

// Adds the scattered light of the light samples that the surface sees.
template <class S>
void add_lights(const LitScene& lit, const std::vector<LightSample>& lights, const LightPoint* points,
                const Surface<S>& o, const int8_t* seen, S* total) {
    for (size_t k = 0; k < lights.size(); ++k)
        if (seen[k] > 0) add_light<S>(lit, lit.lights[lights[k].light], points[k], 1.0 / lights[k].count, o, total);
}
inline void add_lights_vjp(const LitScene& lit, const std::vector<LightSample>& lights, const LightPoint* points,
                           const Surface<double>& o, const int8_t* seen, const double* total_bar, SurfaceBar& bar,
                           Cotangents& to) {
    for (size_t k = 0; k < lights.size(); ++k)
        if (seen[k] > 0)
            add_light_vjp(lit, lit.lights[lights[k].light], points[k], 1.0 / lights[k].count, o, total_bar, bar, to);
}

template <class S>
void radiance(const LitScene& lit, const LitOptions& options, const std::vector<LightSample>& lights,
              const LightPoint* points, const Surface<S>& o, const int8_t* seen, S* total) {
    std::fill(total, total + lit.channels, S(0));
    if (o.is_black()) return;
    if (options.only < 0) add_own_radiance(lit, o, total), add_unshadowed(lit, o, total);
    add_lights(lit, lights, points, o, seen, total);
}
// Returns whether a point has no radiance: it sees no light, and has no other source. It has no derivatives either.
inline bool is_unlit(const LitScene& lit, const LitMesh& mesh, const int8_t* seen, size_t lights) {
    if (!mesh.has_material || mesh.emission.exists()) return false;
    return std::none_of(seen, seen + lights, [](int8_t s) { return s > 0; }) &&
           std::all_of(lit.lights.begin(), lit.lights.end(), [](const Light& light) { return light.casts(); });
}
inline void radiance_vjp(const LitScene& lit, const LitOptions& options, const std::vector<LightSample>& lights,
                         const LightPoint* points, const Surface<double>& o, const int8_t* seen,
                         const double* total_bar, FacePointBar& at_bar, Cotangents& to) {
    SurfaceBar bar(lit.channels);
    if (options.only < 0)
        add_own_radiance_vjp(lit, o, total_bar, bar, to), add_unshadowed_vjp(lit, o, total_bar, bar, to);
    add_lights_vjp(lit, lights, points, o, seen, total_bar, bar, to);
    look_up_material_vjp(lit, o, bar, to);
    surface_vjp(lit, o, bar, to);
    at_bar = bar.at;
}

}  // namespace edgegrad
