// What serves tests and benchmarks alone: single samples laid open, and the rays of an image with nothing else.
#pragma once

#include <cstdint>

#include "accumulate/gradients.h"
#include "forward/forward.h"

namespace edgegrad {

// Radiance (N, C) at pixel positions (N, 2) on the given faces, and its derivative.
template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance);
template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const Gradients& grad);

// Rays as arrays: origins and directions (N, 3), ends (N,); and the faces that each ignores, one list after the other.
struct RayArrays {
    const double *origins, *directions, *ends;
    int64_t size;
};
struct IgnoredArrays {
    const int32_t* faces;
    const int64_t* first;  // (N + 1,)
};

// The face that each ray hits, −1 for none, and whether it meets any.
void cast_rays(const RayCaster& caster, const RayArrays& rays, const IgnoredArrays& ignored, int32_t* face,
               uint8_t* hidden);

// Seconds that the rays of the forward pass take when they are cast and nothing else is done.
double bare_loop(const Camera& camera, const RayCaster& caster, const ImageOptions& options, int packet_width,
                 ThreadTeam& team);

}  // namespace edgegrad
