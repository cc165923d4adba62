// The curves along which shadows end on surfaces, whether the camera sees them there or not: these surfaces light
// others, to which less or more of the light comes by way of them as the curves move.
#pragma once

#include "estimator/view.h"
#include "scene/light_parts.h"

namespace edgegrad {

// Records so many samples on the borders of a light's shadows, by area of the surface that they sweep. Their positions
// in the image are not set, and velocities are by places of vertices and of the light in the world.
template <class T>
void add_indirect_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light,
                          int64_t samples, GradientSink& to);

}  // namespace edgegrad
