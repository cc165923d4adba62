// This file declares the term of indirect shadow boundaries: the curves along which shadows end on surfaces, seen by
// the camera or not. These surfaces light others, and the light that they pass on changes as the curves move.
#pragma once

#include "estimator/view.h"
#include "scene/light_parts.h"

namespace edgegrad {

// Records `samples` samples on a light's shadow boundaries, by the area of the surface that these sweep. The samples
// have no position in the image. Their velocities are by world coordinates of the vertices and of the light.
template <class T>
void add_indirect_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light,
                          int64_t samples, GradientSink& to);

}  // namespace edgegrad
