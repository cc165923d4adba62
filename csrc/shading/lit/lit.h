// Computes the radiance of surfaces with materials, lit by the scene's lights. Shaders written in PyTorch see the same
// points as Hits.
//
//     L(y, v) = emission + Σ f(y, v, l) max(0, n·l) V(y, l) E(y) + irradiance without shadows · base / π
//
// The sum is over one or a few points of each light with an extent. tests/oracles/shading.py computes the same in
// PyTorch.
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

// Writes (N, channels) radiance, which is null where only derivatives are wanted, and (N, light samples) visibility.
template <class T>
void shade(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
           const LitOptions& options, double* radiance, int8_t* seen, ThreadTeam& team);
// Shades about shaded_at_once points on one thread, reusing memory between calls.
constexpr int64_t shaded_at_once = 256;
struct ShadeBuffers;
std::shared_ptr<ShadeBuffers> shade_buffers(const LitScene& lit, const LitOptions& options);
template <class T>
void shade_some(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                const LitOptions& options, ShadeBuffers& buffers, double* radiance, int8_t* seen);
// Writes the points of one light that illuminate these points, `options.samples` for each.
void draw_light_points(const LitScene& lit, const LitPoints& points, const LitOptions& options, int light,
                       LightPoint* out, ThreadTeam& team);
// Adds to the cotangents of the tables, and writes the cotangents of the points, given what shade() found.
void shade_vjp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* bar, const std::vector<TableBar>& to, LitPositions<double> places, ThreadTeam& team);
// Does both at once where only derivatives are wanted: it also traces what each point sees.
template <class T>
void trace_and_shade_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                         const LitPoints& points, const LitOptions& options, const double* bar,
                         const std::vector<TableBar>& to, LitPositions<double> places, ThreadTeam& team);
// Writes the derivative for the tangents of the tables and of the points.
void shade_jvp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               LitPositions<const double> dot, double* radiance_dot, ThreadTeam& team);

}  // namespace edgegrad
