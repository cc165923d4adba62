// Declares the adjoint of the transformation from world to camera coordinates. tangent.h has its derivative.
#pragma once

#include "accumulate/gradients.h"
#include "camera/camera.h"
#include "core/array.h"
#include "core/parallel.h"

namespace edgegrad {

// Adds the adjoint of q = T (R p + t), with the rotation T of a sub-camera: p̄ = (T R)ᵀ q̄, R̄ = Tᵀ Σ q̄ pᵀ, t̄ = Tᵀ Σ
// q̄, for q_bar (V, 3).
void add_world(const Camera& sub_camera, const double* verts, const Array<double>& q_bar, ThreadTeam& team,
               const Gradients& grad);

}  // namespace edgegrad
