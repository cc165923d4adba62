// One of the sides that a camera's rays go through (windows.h).
#pragma once

#include <cmath>
#include <deque>
#include <variant>

#include "camera/camera_rays.h"
#include "camera/vertices.h"
#include "camera/windows.h"
#include "forward/forward.h"
#include "shading/cut_outs.h"

namespace edgegrad {

// What a side of the camera has of its own: the vertices in its frame, and its rays.
struct Side {
    template <class T>
    Side(const SceneView<T>& scene, const Camera& camera_, const RayCaster& caster, const ImageOptions& o, Team& team)
        : camera(camera_),
          q(camera_vertices(camera, scene.verts, scene.n_verts, team)),
          frame(caster, camera, see_through(scene)),
          pixel_rays(camera, o),
          reach{o.filter.radius() * (std::fabs(camera.k_inverse[0]) + std::fabs(camera.k_inverse[1])),
                o.filter.radius() * (std::fabs(camera.k_inverse[2]) + std::fabs(camera.k_inverse[3]))} {}
    Side(const Side&) = delete;  // its parts point to its camera

    const Camera camera;
    const Array<Vec3> q;
    std::variant<std::monostate, CutOuts<float>, CutOuts<double>> cut_outs;
    const CameraFrame frame;
    const PixelRays pixel_rays;
    const Vec2 reach;  // of the filter around a pixel, in normalised image coordinates

   private:
    template <class T>
    const SeenThrough* see_through(const SceneView<T>& scene) {
        return scene.cut_outs.face ? &cut_outs.template emplace<CutOuts<T>>(scene, camera, q.data()) : nullptr;
    }
};

template <class T>
std::deque<Side> make_sides(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                            const ImageOptions& o, Team& team) {
    std::deque<Side> sides;
    for (const Camera& side : sides_of(camera)) sides.emplace_back(scene, side, caster, o, team);
    return sides;
}

}  // namespace edgegrad
