// A scene with materials and lights, as tables and what refers to them by number; and points of its surfaces.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "core/math.h"
#include "shading/lit/antithetic.h"
#include "shading/lit/area.h"
#include "shading/lit/light.h"
#include "shading/lit/normals.h"
#include "shading/lit/source.h"
#include "shading/lit/tables.h"

namespace edgegrad {

struct LitMesh {
    int64_t first_face = 0, faces = 0;
    int32_t first_vertex = 0;
    bool has_material = false, two_sided = true, lambertian = true;
    Source color, base, metallic, roughness, emission;  // the colour of the mesh itself, and its material's
    NormalSource normal;

    std::array<const Source*, 6> sources() const {
        return {&color, &base, &metallic, &roughness, &emission, &normal.map};
    }
};

struct LitScene {
    std::vector<Table> tables;
    std::vector<LitMesh> meshes;  // ascending by first face
    std::vector<Light> lights;
    const int32_t* faces = nullptr;  // (F, 3) rows of `verts`
    int verts = no_table;
    int eye = no_table;  // where it is; in an orthographic view, the unit direction towards it
    bool perspective = true;
    int channels = 0;
    Vec3 center;  // of a ball around all vertices
    double radius = 0;

    const LitMesh& mesh_of(int64_t face) const {
        size_t k = 0;
        while (k + 1 < meshes.size() && face >= meshes[k + 1].first_face) ++k;
        return meshes[k];
    }
    // Whether a texture is looked up by how far pixels lie apart.
    bool is_filtered() const {
        return std::any_of(meshes.begin(), meshes.end(), [](const LitMesh& mesh) {
            const auto all = mesh.sources();
            return std::any_of(all.begin(), all.end(), [](const Source* s) { return s->levels > 1; });
        });
    }
    EmissiveFaces emitter(const Light& light) const {
        const LitMesh& mesh = meshes[light.mesh];
        return {faces, mesh.first_face, mesh.first_vertex, verts, mesh.emission, mesh.two_sided};
    }
};

// What is known of the shadow of one light, instead of being drawn and traced: a row for each point.
struct ForcedLight {
    int light = -1;  // −1: nothing
    const int64_t* index = nullptr;
    const double *uv = nullptr, *pdf = nullptr;
    const uint8_t* lit = nullptr;
};

struct LitPoints {
    int64_t size = 0;
    const int64_t* face = nullptr;
    const double* b = nullptr;      // (N, 3) barycentrics
    const int64_t* seed = nullptr;  // (N,) of random numbers
    ForcedLight forced;
    const double* spread = nullptr;  // (N, 2, 2), see source.h; null: not known

    const double* spread_at(int64_t i) const { return spread ? spread + spread_size * i : nullptr; }

    // So many from `first` on, or those that there are.
    LitPoints part(int64_t first, int64_t count) const {
        LitPoints o{std::min(count, size - first), face + first, b + 3 * first, seed + first, forced, spread_at(first)};
        if (forced.light >= 0)
            o.forced = {forced.light, forced.index + first, forced.uv + 2 * first, forced.pdf + first,
                        forced.lit + first};
        return o;
    }
};

// Cotangents, or tangents, of places.
template <class Number>
struct LitPlaces {
    Number* b = nullptr;       // (N, 3)
    Number* spread = nullptr;  // (N, 2, 2); null: not wanted, or zero
};

constexpr int most_bounces = 64;
// Paths of an image that go on from one point. They share its ray from the camera and its points of lights, and their
// directions fill the sphere more evenly (docs/tried.md).
constexpr int paths_of_point = 4;

struct LitOptions {
    bool shadows = true;
    int samples = 1;  // points of each light with an extent, for each point that is shaded
    int only = -1;    // the light of which alone radiance is wanted; −1: of all that there is
    // Whether only derivatives are wanted: on glossy surfaces points of environments are then drawn in antithetic sets.
    bool antithetic = false;
    double dark = 0;  // points of lights are drawn as if no glossy surface were darker: what is black has derivatives
    int bounces = 1;  // how often light is scattered on its way, at most (path.h)
    // World units, 0: none. Derivatives by where points lie on their faces, of light that is scattered more than once,
    // are those of what does not come from nearer (near_field.h); `only_near_field`: values are those of what does.
    double near = 0;
    bool only_near_field = false;
    int by_paths = -1;  // a light of which no points are drawn for Lambertian surfaces: paths from them find it
};

// Whether a point sees a light sample: 1, or 0 where it is in shadow, or that it was not asked, for the surface is
// turned away from it.
constexpr int8_t not_asked = -1;

struct LightSample {
    int light, sample, count;  // one of so many of a light
};
// What is cast for one sample of a light, where points come in antithetic sets: the image has many more points that are
// lit, and derivatives have both signs (docs/tried.md).
constexpr int sets_for_one = 2;
// The most of them (sets_of() in derivative_points.h).
constexpr int most_sets_for_one = 8;
inline bool draws_antithetic(const LitScene& lit, const LitOptions& options, const Light& light) {
    return options.antithetic && light.kind == Light::Kind::environment &&
           std::any_of(lit.meshes.begin(), lit.meshes.end(), [](const LitMesh& mesh) { return !mesh.lambertian; });
}
inline std::vector<LightSample> light_samples(const LitScene& lit, const LitOptions& options) {
    std::vector<LightSample> out;
    for (int k = 0; k < int(lit.lights.size()); ++k) {
        if (!lit.lights[k].casts() || !(options.only < 0 || options.only == k)) continue;
        const int each = draws_antithetic(lit, options, lit.lights[k]) ? most_sets_for_one * AntitheticSet::most : 1;
        const int count = lit.lights[k].is_punctual() ? 1 : each * options.samples;
        for (int s = 0; s < count; ++s) out.push_back({k, s, count});
    }
    return out;
}

}  // namespace edgegrad
