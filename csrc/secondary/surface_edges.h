// The curves on surfaces at which what these send jumps, whether the camera sees them or not: lines along which faces
// pass through each other, and alpha edges.
#pragma once

#include "secondary/secondary_edges.h"

namespace edgegrad {

// Which of them move.
struct MovingEdges {
    bool crossings, alpha_edges;
};

// Records samples on these curves, each with a point that gets light from there: at so many places, or, if −1, as many
// as by default. They have no position in the image, and velocities are by places of vertices in the world.
template <class T>
void add_surface_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& paths,
                       MovingEdges moving, int64_t samples, GradientSink& to, SecondaryEdgeSamples& out);

}  // namespace edgegrad
