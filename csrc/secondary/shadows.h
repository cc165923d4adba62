// The curves along which shadows end.
#pragma once

#include "estimator/view.h"
#include "scene/light_parts.h"

namespace edgegrad {

// By default, of an image of this size with so many samples a pixel.
int64_t most_shadow_samples(int64_t width, int64_t height, int spp);

// Records samples on the borders of a light's shadows: so many, or, if −1, by default some a pixel of border.
// `casters`: the scene as light meets it, of which less may be there than the camera sees.
template <class T>
void add_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, int64_t samples,
                 const Record& record, GradientSink& to, BackwardProfile& profile);

}  // namespace edgegrad
