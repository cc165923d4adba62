// This file declares the boundary term of discontinuities within faces: alpha edges (rays/alpha_mask.h), and borders of
// nearest texels.
#pragma once

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

// A face that may have discontinuities takes at most these bytes; the list of them doubles as it grows.
constexpr int64_t lined_face_bytes = 3 * 104;

// Adds the samples of lines on the faces in view, GradientOptions::discontinuity_spacing apart; see add_boundary.
template <class T>
void add_discontinuities(const BackwardView<T>& view, const Accumulation& accumulation, GradientSink& to,
                         BackwardProfile& profile);

}  // namespace edgegrad
