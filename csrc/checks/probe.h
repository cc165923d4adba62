// Serves tests and benchmarks alone: it exposes single samples, and the rays of an image without anything else.
#pragma once

#include <cstdint>

#include "accumulate/gradients.h"
#include "forward/forward.h"

namespace edgegrad {

// These write the radiance (N, C) at pixel positions (N, 2) on the given faces, and its derivative.
template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance);
template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const Gradients& grad);

// Holds rays: origins and directions (N, 3), ends (N,). The lists of faces that each ignores are concatenated.
struct RayArrays {
    const double *origins, *directions, *ends;
    int64_t size;
};
struct IgnoredArrays {
    const int32_t* faces;
    const int64_t* first;  // (N + 1,)
};

// Writes the face that each ray hits, −1 for none, and whether it hits any.
void cast_rays(const RayCaster& caster, const RayArrays& rays, const IgnoredArrays& ignored, int32_t* face,
               uint8_t* hidden);

// Returns the seconds that casting the rays of the forward pass takes, without anything else.
double bare_loop(const Camera& camera, const RayCaster& caster, const ImageOptions& options, int packet_width,
                 ThreadTeam& team);

}  // namespace edgegrad
