// The curves along which what surfaces of a path of light see of one another ends.
#pragma once

#include <vector>

#include "estimator/view.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

// By default, of an image of this size with so many samples a pixel.
int64_t most_secondary_edge_samples(int64_t width, int64_t height, int spp);

// What light is scattered by, and how often: `further` times of these after the end of a line that it comes to, which
// the camera sees, or need not.
struct LitPaths {
    const LitScene& lit;
    const LitOptions& options;
    int further = 0;
    bool seen = true;
};

// Of each chunk of samples, an array each. (S, channels) by how much the image jumps at them, times what a sample
// stands for; or, where the camera need not see the end of a line, what has come there, and (S, 3) from where, in unit
// directions.
struct SecondaryEdgeSamples {
    std::vector<std::vector<double>> jump, origin;
};

// Records samples on these borders: so many lines, or, if −1, by default. `casters`: the scene as light meets it, of
// which less may be there than the camera sees. An end of a line that need not be seen has no position in the image,
// and velocities are by places of vertices in the world.
template <class T>
void add_secondary_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& paths,
                         int64_t samples, const Record& record, GradientSink& to, SecondaryEdgeSamples& out);

}  // namespace edgegrad
