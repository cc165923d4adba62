// Light that goes from one point of a surface to another, were nothing between them: the reflector gets it from lights,
// or by way of further surfaces. With its radiance L towards the receiver, without what it emits itself, the viewer
// sees
//
//     f(v, l) L (n · l) / |g · l|
//
// of it by the measure of lines, in which the cosine of the receiver's face is (g is its normal, n that for shading).
#pragma once

#include <cstdint>

#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/path.h"

namespace edgegrad {

// Points by face and barycentrics (N, 3), and seeds of the numbers that are drawn at reflectors.
struct LitLines {
    int64_t size = 0;
    const int64_t *receiver = nullptr, *reflector = nullptr;
    const double *receiver_b = nullptr, *reflector_b = nullptr;
    const int64_t* seed = nullptr;
};

// (N, channels), of few lines on one thread: what the viewer sees, or L, that comes to the receiver from wherever it is
// seen. `paths`: from reflectors, by which light is scattered so often at most as it may be up to there.
enum class Received { by_viewer, there };
template <class T>
void send_between(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitLines& lines,
                  Received received, Paths& paths, double* radiance);

}  // namespace edgegrad
