// Holds a scene with materials and lights, as tables and references to them by number, and points of its surfaces.
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
    // These are the colour of the mesh itself, and the parameters of its material.
    Source color, base, metallic, roughness, emission;
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
    int eye = no_table;  // position, or the unit direction towards the eye in an orthographic view
    bool perspective = true;
    int channels = 0;
    Vec3 center;  // centre of a bounding sphere of all vertices
    double radius = 0;

    const LitMesh& mesh_of(int64_t face) const {
        size_t k = 0;
        while (k + 1 < meshes.size() && face >= meshes[k + 1].first_face) ++k;
        return meshes[k];
    }
    // Returns whether some texture is filtered by the footprints of pixels.
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

// Fixes the sampled point and the shadow of one light, which are then neither drawn nor traced; each point has a row.
struct ForcedLight {
    int light = -1;  // −1 means none.
    const int64_t* index = nullptr;
    const double *uv = nullptr, *pdf = nullptr;
    const uint8_t* lit = nullptr;
};

struct LitPoints {
    int64_t size = 0;
    const int64_t* face = nullptr;
    const double* b = nullptr;      // (N, 3) barycentrics
    const int64_t* seed = nullptr;  // (N,) seeds of random numbers
    ForcedLight forced;
    const double* spread = nullptr;  // (N, 2, 2), see source.h; null: unknown

    const double* spread_at(int64_t i) const { return spread ? spread + spread_size * i : nullptr; }

    // Returns `count` points from `first` on, or as many as there are.
    LitPoints part(int64_t first, int64_t count) const {
        LitPoints o{std::min(count, size - first), face + first, b + 3 * first, seed + first, forced, spread_at(first)};
        if (forced.light >= 0)
            o.forced = {forced.light, forced.index + first, forced.uv + 2 * first, forced.pdf + first,
                        forced.lit + first};
        return o;
    }
};

// Points to the cotangents or tangents of positions.
template <class Number>
struct LitPositions {
    Number* b = nullptr;       // (N, 3)
    Number* spread = nullptr;  // (N, 2, 2); null: not wanted, or zero
};

constexpr int most_bounces = 64;
// An image starts this many paths at one point. They share the camera ray and the light samples, and their directions
// fill the sphere more evenly (docs/tried.md).
constexpr int paths_of_point = 4;

struct LitOptions {
    bool shadows = true;
    int samples = 1;  // number of points of each light with an extent
    int only = -1;    // Only this light contributes; −1 means all.
    // Only derivatives are wanted. Glossy surfaces then sample environments in antithetic sets.
    bool antithetic = false;
    // Light sampling treats darker glossy surfaces as this dark, because black ones have derivatives, too.
    double dark = 0;
    int bounces = 1;  // bound on how often light is scattered (path.h)
    // The radius of the near field in world units, 0: none. Derivatives of indirect light with respect to positions on
    // faces then leave out the near part (near_field.h). With `only_near_field`, values are those of the near part.
    double near = 0;
    bool only_near_field = false;
    int by_paths = -1;  // Paths find this light from Lambertian surfaces, which draw no points of it.
};

// Marks a light sample behind the surface, which is not traced. Otherwise visibility is 1, or 0 in shadow.
constexpr int8_t not_sampled = -1;

struct LightSample {
    int light, sample, count;  // one of `count` samples of a light
};
// Counts the antithetic sets that replace one sample of a light. The image has many more points that are lit, and
// derivatives have both signs (docs/tried.md).
constexpr int sets_for_one = 2;
// Bounds what sets_of() in derivative_points.h returns.
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
