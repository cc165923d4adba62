// What serves tests and benchmarks alone: single samples laid open, and the rays of an image with nothing else.
#pragma once

#include <cstdint>

#include "forward/forward.h"
#include "scene/gradients.h"

namespace edgegrad {

// Radiance (N, C) at pixel positions (N, 2) on the given faces, and its derivative.
template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance);
template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const Gradients& grad);

// Seconds that the rays of the forward pass take when they are cast and nothing else is done.
double bare_loop(const Camera& camera, const RayCaster& caster, const ImageOptions& options, int packet_width,
                 Team& team);

}  // namespace edgegrad
