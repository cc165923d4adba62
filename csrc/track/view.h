// Projects points of the camera's frame to pixels, with their derivatives, and makes rays through pixels, for any lens.
#pragma once

#include <optional>
#include <vector>

#include "camera/sub_cameras.h"
#include "rays/ray_batch.h"

namespace edgegrad {

// Holds where a point is seen, and the gradients of both coordinates by the point in the camera's frame.
struct SeenPoint {
    Vec2 x;
    Vec3 dx, dy;
};

class TrackCamera {
   public:
    // The camera's frame is that of world_to_camera.
    explicit TrackCamera(const Camera& camera);

    int width() const { return width_; }
    int height() const { return height_; }
    bool perspective() const { return perspective_; }
    // Returns whether K swaps left and right.
    bool mirrors() const { return mirrors_; }

    // Returns the position in the image, or nothing where the lens does not show the point. It may lie outside of the
    // image.
    std::optional<Vec2> position(Vec3 q) const;
    // Returns the same with the derivatives.
    std::optional<SeenPoint> project(Vec3 q) const;

    // Returns the ray through a pixel position, or nothing where nothing is seen. An orthographic one begins at z = 0,
    // and shows what lies before, too.
    std::optional<Ray> ray(Vec2 x) const;

    bool contains(Vec2 x, double margin) const {
        return x.x > margin && x.y > margin && x.x < width_ - margin && x.y < height_ - margin;
    }

   private:
    // Returns the sub-camera that shows the point, and the point in its frame.
    const Camera* sub_camera(Vec3 q, Vec3& there) const;

    std::vector<Camera> points_, rays_;
    int width_, height_;
    bool perspective_, mirrors_, is_single_;
};

}  // namespace edgegrad
