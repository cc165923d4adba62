// Computes the light that goes from one surface point, the reflector, to another, the shading point, if nothing
// occludes it. The reflector gets light from lights, or from further surfaces. Let L be its radiance towards the
// shading point, without its own emission. The viewer sees
//
//     f(v, l) L (n · l) / |g · l|
//
// with respect to the measure of lines, which contains the cosine of the shading point's face. g is the normal of that
// face, n its shading normal.
#pragma once

#include <cstdint>

#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/path.h"

namespace edgegrad {

// Holds points by face and barycentrics (N, 3), and seeds of the random numbers used at reflectors.
struct LitLines {
    int64_t size = 0;
    const int64_t *receiver = nullptr, *reflector = nullptr;
    const double *receiver_b = nullptr, *reflector_b = nullptr;
    const int64_t* seed = nullptr;
};

// Writes (N, channels) for a few lines, on one thread. `wanted` selects what the viewer sees, or L, which reaches the
// shading point from wherever it is viewed. `paths` start at reflectors, and their bounces limit how often light is
// scattered up to there.
enum class SentRadiance { seen_by_viewer, at_receiver };
template <class T>
void send_between(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitLines& lines,
                  SentRadiance wanted, Paths& paths, double* radiance);

}  // namespace edgegrad
