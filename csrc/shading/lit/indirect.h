// Computes indirect light at the points that lit.h lights directly, as radiance to be added. It traces a path of at
// most options.bounces points each. The points' seeds supply the random numbers, so derivatives retrace the same paths.
#pragma once

#include <memory>
#include <vector>

#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/tables.h"

namespace edgegrad {

// Writes (N, channels).
template <class T>
void indirect(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
              const LitOptions& options, double* radiance, ThreadTeam& team);
// Adds the indirect light of about shaded_at_once points, on one thread, reusing memory between calls.
class Paths;
std::shared_ptr<Paths> path_buffers(const LitScene& lit, const LitOptions& options);
template <class T>
void add_indirect(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  Paths& paths, double* radiance);
// Writes the whole radiance (N, channels) for an image, with direct light. `seen` (N, light samples) gets the
// visibility of one sample of each light.
template <class T>
void shade_by_paths(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                    Paths& paths, double* radiance, int8_t* seen);
// Adds to the cotangents of the tables, and writes the cotangents of the points.
template <class T>
void indirect_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, const double* bar, const std::vector<TableBar>& to,
                  LitPositions<double> places, ThreadTeam& team);
// Writes the derivative for the tangents of the tables and of the points.
template <class T>
void indirect_jvp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, LitPositions<const double> dot, double* radiance_dot, ThreadTeam& team);

}  // namespace edgegrad
