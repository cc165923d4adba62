// What is seen through the centre of each pixel.
#pragma once

#include <cstdint>

#include "camera/camera.h"
#include "core/parallel.h"
#include "rays/camera_rays.h"
#include "scene/scene.h"

namespace edgegrad {

// Writes the face that the ray through the centre of each pixel hits to `face` (H, W); −1: none.
template <class T>
void faces_at_centers(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, ThreadTeam& team,
                      int32_t* face);

}  // namespace edgegrad
