// Holds the sub-cameras through which a camera's rays pass (sub_cameras.h).
#pragma once

#include <deque>
#include <variant>

#include "core/array.h"
#include "forward/forward.h"
#include "rays/alpha_mask.h"
#include "rays/camera_rays.h"

namespace edgegrad {

// Holds a sub-camera's own vertices in its frame, and its rays.
struct SubCameraRays {
    template <class T>
    SubCameraRays(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, const ImageOptions& o,
                  ThreadTeam& team);
    SubCameraRays(const SubCameraRays&) = delete;  // Its parts point to its camera.
    ~SubCameraRays();

    const Camera camera;
    const Array<Vec3> q;
    std::variant<std::monostate, AlphaMasks<float>, AlphaMasks<double>> alpha_masks;
    const CameraFrame frame;
    const PixelRays pixel_rays;
    const Vec2 reach;  // filter's reach around a pixel, in normalised image coordinates

   private:
    template <class T>
    const AlphaTest* see_through(const SceneView<T>& scene);
};

template <class T>
std::deque<SubCameraRays> make_sub_camera_rays(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                                               const ImageOptions& o, ThreadTeam& team);

}  // namespace edgegrad
