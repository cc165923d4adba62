// The curves along which shadows end.
#pragma once

#include "backward/view.h"
#include "scene/light_points.h"

namespace edgegrad {

// Adds what samples on the borders of shadows find: by default some a pixel of border, or so many.
template <int N, class Contraction, class T>
void add_shadows(const BackwardView<T>& view, const LightPoints& lights, int64_t samples,
                 const Contraction& contraction, Destination& to, BackwardProfile& profile);

}  // namespace edgegrad
