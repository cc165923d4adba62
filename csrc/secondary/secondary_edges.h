// This file declares the term of secondary edges: the curves at which visibility between surfaces changes.
#pragma once

#include <vector>

#include "estimator/view.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

// LitPaths holds what scatters light, and how often. After a line's end, light is scattered up to `further` more times.
// `seen` tells whether the camera must see that end.
struct LitPaths {
    const LitScene& lit;
    const LitOptions& options;
    int further = 0;
    bool seen = true;
};

// SecondaryEdgeSamples holds one array per chunk of samples. `jump` (S, channels) is the jump of the image times the
// sample's weight. If the camera need not see the end, it is the light that arrives there. `origin` (S, 3) then holds
// the unit directions to its source.
struct SecondaryEdgeSamples {
    std::vector<std::vector<double>> jump, origin;
};

// Records `samples` samples on secondary edges; −1 selects the default. `casters` is the scene as light meets it, which
// may lack faces that the camera sees. An end that need not be seen has no position in the image. Its velocities are by
// world coordinates of the vertices.
template <class T>
void add_secondary_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& paths,
                         int64_t samples, const Record& record, GradientSink& to, SecondaryEdgeSamples& out);

}  // namespace edgegrad
