// Finds where a camera shows surface points if nothing occludes them. Light tracing connects paths to pixels with it.
#pragma once

#include <cmath>
#include <vector>

#include "camera/camera.h"
#include "camera/sub_cameras.h"
#include "camera/view_volume.h"

namespace edgegrad {

struct CameraConnection {
    Vec2 x;             // pixel position
    double area_scale;  // image's area, px², per unit area of the surface
    double spread[4];   // changes of the barycentrics along the two sides per pixel to the right and down
};

class CameraConnections {
   public:
    // The pixel filter widens the image by `reach` px beyond its borders.
    CameraConnections(const Camera& camera, double reach) {
        for (const Camera& sub_camera : sub_cameras_for_points(camera, reach))
            sub_cameras_.push_back({sub_camera, {sub_camera, reach}});
    }

    // Calls body(CameraConnection) for each image position of the point y of a face with the sides e1 and e2 (world).
    template <class Body>
    void each(Vec3 y, Vec3 e1, Vec3 e2, Body body) const {
        for (const SubCamera& sub_camera : sub_cameras_) {
            const Camera& c = sub_camera.camera;
            const Vec3 q = c.to_camera(y);
            if (!(c.depth_weight(q) > 0) || sub_camera.volume.outcode(q) != 0) continue;
            const Distorted distorted = distort(c, project(c, q));
            if (!(distorted.area_scale != 0)) continue;
            const Vec2 u = project_jvp(c, q, c.R * e1, {}), v = project_jvp(c, q, c.R * e2, {});
            const double area = u.x * v.y - u.y * v.x;
            if (!(std::fabs(area) > 0)) continue;  // The face is edge-on.
            body(CameraConnection{distorted.x,
                                  std::fabs(area) / length(cross(e1, e2)),
                                  {v.y / area, -u.y / area, -v.x / area, u.x / area}});
        }
    }

   private:
    struct SubCamera {
        Camera camera;
        ViewVolume volume;
    };
    std::vector<SubCamera> sub_cameras_;
};

}  // namespace edgegrad
