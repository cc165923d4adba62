// One of the sides that a camera's rays go through (sub_cameras.h).
#pragma once

#include <deque>
#include <variant>

#include "core/array.h"
#include "forward/forward.h"
#include "rays/alpha_mask.h"
#include "rays/camera_rays.h"

namespace edgegrad {

// What a side of the camera has of its own: the vertices in its frame, and its rays.
struct Side {
    template <class T>
    Side(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, const ImageOptions& o,
         ThreadTeam& team);
    Side(const Side&) = delete;  // its parts point to its camera
    ~Side();

    const Camera camera;
    const Array<Vec3> q;
    std::variant<std::monostate, AlphaMasks<float>, AlphaMasks<double>> alpha_masks;
    const CameraFrame frame;
    const PixelRays pixel_rays;
    const Vec2 reach;  // of the filter around a pixel, in normalised image coordinates

   private:
    template <class T>
    const AlphaTest* see_through(const SceneView<T>& scene);
};

template <class T>
std::deque<Side> make_sides(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                            const ImageOptions& o, ThreadTeam& team);

}  // namespace edgegrad
