// What the viewer sees of light that goes from one point of a surface to another, were nothing between them: the sender
// gets it from lights, or by way of further surfaces, and the receiver scatters it. With the sender's radiance L
// towards the receiver, without what it emits itself, that is
//
//     f(v, l) L (n · l) / |g · l|
//
// by the measure of lines, in which the cosine of the receiver's face is (g is its normal, n that for shading).
#pragma once

#include <cstdint>

#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/path.h"

namespace edgegrad {

// Points by face and barycentrics (N, 3), and seeds of the numbers that are drawn at senders.
struct LitLines {
    int64_t size = 0;
    const int64_t *receiver = nullptr, *sender = nullptr;
    const double *receiver_b = nullptr, *sender_b = nullptr;
    const int64_t* seed = nullptr;
};

// (N, channels), of few lines on one thread. `paths`: of points that scatter the light once less than it is in all.
template <class T>
void send_between(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitLines& lines,
                  Paths& paths, double* radiance);

}  // namespace edgegrad
