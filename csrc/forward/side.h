// One of the sides that a camera's rays go through (windows.h).
#pragma once

#include <cmath>
#include <deque>

#include "camera/camera_rays.h"
#include "camera/vertices.h"
#include "camera/windows.h"
#include "forward/forward.h"

namespace edgegrad {

// What a side of the camera has of its own: the vertices in its frame, and its rays.
struct Side {
    Side(const Camera& camera_, const double* verts, int64_t n_verts, const RayCaster& caster, const ImageOptions& o,
         Team& team)
        : camera(camera_),
          q(camera_vertices(camera, verts, n_verts, team)),
          frame(caster, camera),
          pixel_rays(camera, o),
          reach{o.filter.radius() * (std::fabs(camera.k_inverse[0]) + std::fabs(camera.k_inverse[1])),
                o.filter.radius() * (std::fabs(camera.k_inverse[2]) + std::fabs(camera.k_inverse[3]))} {}
    Side(const Side&) = delete;  // its parts point to its camera

    const Camera camera;
    const Array<Vec3> q;
    const CameraFrame frame;
    const PixelRays pixel_rays;
    const Vec2 reach;  // of the filter around a pixel, in normalised image coordinates
};

inline std::deque<Side> make_sides(const Camera& camera, const double* verts, int64_t n_verts, const RayCaster& caster,
                                   const ImageOptions& o, Team& team) {
    std::deque<Side> sides;
    for (const Camera& side : sides_of(camera)) sides.emplace_back(side, verts, n_verts, caster, o, team);
    return sides;
}

}  // namespace edgegrad
