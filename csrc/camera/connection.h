// Where a camera has points of surfaces in its image, as far as nothing hides them: how light that is followed from its
// source comes to pixels.
#pragma once

#include <cmath>
#include <vector>

#include "camera/camera.h"
#include "camera/view_volume.h"
#include "camera/windows.h"

namespace edgegrad {

struct CameraConnection {
    Vec2 x;             // the pixel position
    double area_scale;  // px² of the image that an area of the surface fills, per unit
};

class CameraConnections {
   public:
    // reach  how far beyond its borders, px, the image shows something: the pixel filter's
    CameraConnections(const Camera& camera, double reach) {
        for (const Camera& window : windows_of(camera, reach)) windows_.push_back({window, {window, reach}});
    }

    // Calls body(CameraConnection) for each place of the image at which the point y of a surface lies, that two vectors
    // span, in world coordinates.
    //
    // Along the ray dq/dz = r of the camera, the area A of a surface with the normal g fills A |g · r| / u² of the
    // plane of normalised coordinates, u world units of which fill one of n.
    template <class Body>
    void each(Vec3 y, Vec3 e1, Vec3 e2, Body body) const {
        for (const Window& window : windows_) {
            const Camera& c = window.camera;
            const Vec3 q = c.to_camera(y);
            const double w = c.depth_weight(q);
            if (!(w > 0) || window.volume.outcode(q) != 0) continue;
            const Bent bent = bend(c, project(c, q));
            if (!(bent.area_scale != 0)) continue;
            const Vec3 g = (1 / length(cross(e1, e2))) * cross(c.R * e1, c.R * e2);
            const double u = c.unit_at_depth(q.z), filled = std::fabs(c.along_ray(g, {q.x / w, q.y / w})) / (u * u);
            body(CameraConnection{bent.x, filled * std::fabs(c.k_det * bent.area_scale)});
        }
    }

   private:
    struct Window {
        Camera camera;
        ViewVolume volume;
    };
    std::vector<Window> windows_;
};

}  // namespace edgegrad
