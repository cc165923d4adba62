// Radiance of surfaces with materials in the light of a scene, at points that shaders written in PyTorch see as Hits:
//
//     L(y, v) = emission + Σ f(y, v, l) max(0, n·l) V(y, l) E(y) + irradiance without shadows · base / π
//
// with one point, or a few, of each light that has an extent. edgegrad/_lit.py computes the same in PyTorch: it serves
// where this does not, and as its reference.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/area.h"
#include "shading/lit/lamp.h"
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
};

struct LitScene {
    std::vector<Table> tables;
    std::vector<LitMesh> meshes;  // ascending by first face
    std::vector<Lamp> lamps;
    const int32_t* faces = nullptr;  // (F, 3) rows of `verts`
    int verts = no_table;
    int eye = no_table;  // where it is; in an orthographic view, the unit direction towards it
    bool perspective = true;
    int channels = 0;
    Vec3 center;  // of a ball around all vertices
    double radius = 0;
    uint64_t step[3] = {};  // of random numbers, from one seed to the next

    const LitMesh& mesh_of(int64_t face) const;
    EmissiveFaces emitter(const Lamp& lamp) const {
        const LitMesh& mesh = meshes[lamp.mesh];
        return {faces, mesh.first_face, mesh.first_vertex, verts, mesh.emission, mesh.two_sided};
    }
};

// What is known of the shadow of one light, instead of being drawn and traced: a row for each point.
struct ForcedLight {
    int lamp = -1;  // −1: nothing
    const int64_t* index = nullptr;
    const double *uv = nullptr, *density = nullptr;
    const uint8_t* lit = nullptr;
};

struct LitPoints {
    int64_t size = 0;
    const int64_t* face = nullptr;
    const double* b = nullptr;      // (N, 3) barycentrics
    const int64_t* seed = nullptr;  // (N,) of random numbers
    ForcedLight forced;

    // So many from `first` on, or those that there are.
    LitPoints part(int64_t first, int64_t count) const {
        LitPoints o{std::min(count, size - first), face + first, b + 3 * first, seed + first, forced};
        if (forced.lamp >= 0)
            o.forced = {forced.lamp, forced.index + first, forced.uv + 2 * first, forced.density + first,
                        forced.lit + first};
        return o;
    }
};

struct LitOptions {
    bool shadows = true;
    int samples = 1;  // points of each light with an extent, for each point that is shaded
    int only = -1;    // the lamp of which alone radiance is wanted; −1: of all that there is
};

// Whether points of lights are seen, by points and then by lights and their samples.
constexpr int8_t not_asked = -1;
struct LightSample {
    int lamp, sample, count;  // one of so many of a lamp
};
std::vector<LightSample> light_samples(const LitScene& lit, const LitOptions& options);

// (N, channels) radiance, null where only derivatives are wanted, and (N, light samples) what was found of lights.
template <class T>
void shade(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
           const LitOptions& options, double* radiance, int8_t* seen, Team& team);
// The same of few points, about so many, on one thread, which keeps what it needs from one call to the next.
constexpr int64_t shaded_at_once = 256;
struct ShadeRoom;
std::shared_ptr<ShadeRoom> shade_room(const LitScene& lit, const LitOptions& options);
template <class T>
void shade_some(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                const LitOptions& options, ShadeRoom& room, double* radiance, int8_t* seen);
// From what shade() found. Adds to the cotangents of the tables, and writes those of b (N,
// 3).
void shade_vjp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* bar, const std::vector<TableBar>& to, double* b_bar, Team& team);
// The same at once, of points of which only derivatives are wanted: what each sees is found here.
template <class T>
void look_and_shade_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                        const LitPoints& points, const LitOptions& options, const double* bar,
                        const std::vector<TableBar>& to, double* b_bar, Team& team);
// For the tangents of the tables, and of b (N, 3).
void shade_jvp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* b_dot, double* radiance_dot, Team& team);

}  // namespace edgegrad
