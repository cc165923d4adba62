// The interior term ∫ Ã · ∂L/∂Φ dx: what changes inside the faces.
#pragma once

#include "importance.h"
#include "render.h"
#include "scatter.h"

namespace edgegrad {

// What both terms of the backward pass look at.
template <class T>
struct BackwardView {
    const SceneView<T>& scene;
    const Camera& camera;
    const Geometry& geometry;
    const ViewVolume& volume;
    const VertexView& vertices;
    const FilteredAdjoint<T>& adjoint;
    const Importance& importance;
    const BackwardOptions& options;
    const RayFrame& frame;
};

// Adds to `to`; `geometry` says whether points and camera are wanted too. Returns the number of samples.
template <int N, class T>
int64_t add_interior(const BackwardView<T>& view, bool geometry, Destination& to);

}  // namespace edgegrad
