// This file declares the term of surface edges: curves at which the light that surfaces send jumps, seen by the camera
// or not. They are intersections of faces, and alpha edges.
#pragma once

#include "secondary/secondary_edges.h"

namespace edgegrad {

// MovingEdges tells which kinds of these curves move.
struct MovingEdges {
    bool crossings, alpha_edges;
};

// Records samples on these curves, each with a point lit from there. `samples` is their number; −1 selects the default.
// They have no position in the image. Their velocities are by world coordinates of the vertices.
template <class T>
void add_surface_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& paths,
                       MovingEdges moving, int64_t samples, GradientSink& to, SecondaryEdgeSamples& out);

}  // namespace edgegrad
