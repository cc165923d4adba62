// The boundary term of steps within faces: of what is alpha-tested (rays/alpha_mask.h), and of borders between texels
// where the nearest one is taken.
#pragma once

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

// Bytes of a face that may have steps, at most; the list of them doubles as it grows.
constexpr int64_t lined_face_bytes = 3 * 104;

// Adds what lines find on the faces in view, GradientOptions::step_spacing apart; see add_boundary.
template <class T>
void add_steps(const BackwardView<T>& view, const Accumulation& accumulation, GradientSink& to,
               BackwardProfile& profile);

}  // namespace edgegrad
