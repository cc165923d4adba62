// This file declares the boundary term of curves that the camera sees: the change of the image as a discontinuity moves
// in it.
//
//     Σ_curves ∫ Ã(x(s)) · [L₋ − L₊](s) (∂x/∂Φ ∧ dx/ds) ds
//
// L₋ and L₊ are the radiance on the two sides of the curve. The normal of ∂x ∧ τ = ∂x · (τ_y, −τ_x) points to the side
// of L₊. This is the Dirac integral of Li, Aittala, Durand and Lehtinen 2018, Eq. 4 and 5, without the division by
// |dx/ds|. An edge that is short, or seen end-on, therefore gives a small number and not 0/0.
#pragma once

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

template <class T>
struct Curves;

// Adds the contribution of n samples on the measured curves.
template <class T>
void add_boundary(const BackwardView<T>& view, Curves<T>& curves, int64_t n, const Accumulation& accumulation,
                  GradientSink& to, BackwardProfile& profile);

}  // namespace edgegrad
