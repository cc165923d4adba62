// The boundary term: what changes because a curve of discontinuity moves in the image.
//
//     Σ_curves ∫ Ã(x(s)) · [L₋ − L₊](s) (∂x/∂Φ ∧ dx/ds) ds
//
// with L₋ and L₊ the radiance on the two sides of the curve: the normal of ∂x ∧ τ = ∂x · (τ_y, −τ_x) points to the side
// of L₊. This is the Dirac integral of Li, Aittala, Durand and Lehtinen 2018, Eq. 4 and 5, without the division by
// |dx/ds|: an edge that is short, or seen end-on, gives a small number and not 0/0.
#pragma once

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

template <class T>
struct Curves;

// Adds what n samples find on the measured curves.
template <class T>
void add_boundary(const BackwardView<T>& view, Curves<T>& curves, int64_t n, const Accumulation& accumulation,
                  GradientSink& to, BackwardProfile& profile);

}  // namespace edgegrad
