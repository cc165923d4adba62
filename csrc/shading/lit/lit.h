// Radiance of surfaces with materials in the light of a scene, at points that shaders written in PyTorch see as Hits:
//
//     L(y, v) = emission + Σ f(y, v, l) max(0, n·l) V(y, l) E(y) + irradiance without shadows · base / π
//
// with one point, or a few, of each light that has an extent. edgegrad/light/radiance.py computes the same in PyTorch:
// it serves where this does not, and as its reference.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/tables.h"

namespace edgegrad {

// (N, channels) radiance, null where only derivatives are wanted, and (N, light samples) what was found of lights.
template <class T>
void shade(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
           const LitOptions& options, double* radiance, int8_t* seen, ThreadTeam& team);
// The same of few points, about so many, on one thread, which keeps what it needs from one call to the next.
constexpr int64_t shaded_at_once = 256;
struct ShadeBuffers;
std::shared_ptr<ShadeBuffers> shade_buffers(const LitScene& lit, const LitOptions& options);
template <class T>
void shade_some(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                const LitOptions& options, ShadeBuffers& buffers, double* radiance, int8_t* seen);
// The points of one light that these are lit by, `options.samples` for each.
void draw_light_points(const LitScene& lit, const LitPoints& points, const LitOptions& options, int light,
                       LightPoint* out, ThreadTeam& team);
// From what shade() found. Adds to the cotangents of the tables, and writes those of the points.
void shade_vjp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* bar, const std::vector<TableBar>& to, LitPlaces<double> places, ThreadTeam& team);
// The same at once, of points of which only derivatives are wanted: what each sees is found here.
template <class T>
void trace_and_shade_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                         const LitPoints& points, const LitOptions& options, const double* bar,
                         const std::vector<TableBar>& to, LitPlaces<double> places, ThreadTeam& team);
// For the tangents of the tables and of the points.
void shade_jvp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               LitPlaces<const double> dot, double* radiance_dot, ThreadTeam& team);

}  // namespace edgegrad
