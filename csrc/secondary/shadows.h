// This file declares the term of shadow boundaries that the camera sees.
#pragma once

#include "estimator/view.h"
#include "scene/light_parts.h"

namespace edgegrad {

// Records `samples` samples on a light's shadow boundaries; −1 selects a default number per pixel of boundary.
// `casters` is the scene as light meets it, which may lack faces that the camera sees.
template <class T>
void add_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, int64_t samples,
                 const Record& record, GradientSink& to);

}  // namespace edgegrad
