// The image.
#pragma once

#include <cstdint>

#include "camera/camera.h"
#include "core/parallel.h"
#include "core/sampler.h"
#include "estimator/hit_buffers.h"
#include "estimator/pixel_samples.h"
#include "film/film.h"
#include "rays/camera_rays.h"
#include "scene/scene.h"

namespace edgegrad {

// Writes `image` (H, W, C) and `hits`.
template <class T>
void render_forward(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                    const ImageOptions& options, ThreadTeam& team, T* image, const HitBuffers<T>& hits);

}  // namespace edgegrad
