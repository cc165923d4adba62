// The curves along which what surfaces of a path of light see of one another ends.
#pragma once

#include <vector>

#include "backward/view.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

// By default, of an image of this size with so many samples a pixel.
int64_t most_bounce_samples(int64_t width, int64_t height, int spp);

// What light is scattered by, and how often.
struct LitPaths {
    const LitScene& lit;
    const LitOptions& options;
};

// Records samples on these borders, and appends for the records of each chunk by how much the image jumps at each of
// them, (S, channels) of the lit scene, times what a sample stands for. So many lines, or, if −1, by default.
// `casters`: the scene as light meets it, of which less may be there than the camera sees.
template <class T>
void add_bounces(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& paths, int64_t samples,
                 const Record& record, Destination& to, std::vector<std::vector<double>>& jumps);

}  // namespace edgegrad
