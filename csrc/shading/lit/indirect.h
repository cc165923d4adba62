// Light that reaches surfaces by way of others, at the points that lit.h lights directly: radiance that is to be added,
// by one path of at most options.bounces points for each. Their random numbers are those of the points' seeds, so that
// the same paths are found again for derivatives.
#pragma once

#include <memory>
#include <vector>

#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/tables.h"

namespace edgegrad {

// (N, channels).
template <class T>
void indirect(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
              const LitOptions& options, double* radiance, ThreadTeam& team);
// Adds that of few points, about shaded_at_once, on one thread, which keeps what it needs from one call to the next.
class Paths;
std::shared_ptr<Paths> path_buffers(const LitScene& lit, const LitOptions& options);
template <class T>
void add_indirect(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  Paths& paths, double* radiance);
// All of their radiance, direct light as well, for an image: (N, channels), and (N, light samples) what was found of
// lights, of each one sample.
template <class T>
void shade_whole(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                 Paths& paths, double* radiance, int8_t* seen);
// Adds to the cotangents of the tables, and writes those of the points.
template <class T>
void indirect_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, const double* bar, const std::vector<TableBar>& to,
                  LitPlaces<double> places, ThreadTeam& team);
// For the tangents of the tables and of the points.
template <class T>
void indirect_jvp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, LitPlaces<const double> dot, double* radiance_dot, ThreadTeam& team);

}  // namespace edgegrad
