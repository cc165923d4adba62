// The curves along which shadows end.
#pragma once

#include "backward/view.h"
#include "scene/light_points.h"

namespace edgegrad {

// By default, of an image of this size with so many samples a pixel.
int64_t most_shadow_samples(int64_t width, int64_t height, int spp);

// Adds what samples on the borders of shadows find: by default some a pixel of border, or so many.
template <int N, class Contraction, class T>
void add_shadows(const BackwardView<T>& view, const LightPoints& lights, int64_t samples,
                 const Contraction& contraction, Destination& to, BackwardProfile& profile);

}  // namespace edgegrad
