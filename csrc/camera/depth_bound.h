// Bounds the depth of what is hit in a pixel, one bound per face, which the backward pass keeps per pixel. Whatever
// lies behind the bound in all pixels that it touches is most likely occluded (occlusion.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "camera/camera.h"

namespace edgegrad {

// Bounds the depth of one face within a pixel. In the plane of a face, depth is a function of an affine function of n.
class DepthBound {
   public:
    void set(const Camera& camera, const Vec3 q[3], const FaceMap& map) {
        const double low = std::min({q[0].z, q[1].z, q[2].z}), high = camera.greatest_depth(q);
        camera_ = &camera, farthest_ = high;
        // A face whose depth changes by at most two pixels' width needs no plane; its corners suffice. Through a
        // distorting lens, a pixel is not a box in n.
        const double width = 2 / camera.pixels_per_unit;
        tilted_ = camera.is_undistorted() && !(high - low <= width * camera.unit_at_depth(low));
        if (!tilted_) return;
        const FaceRows rows{map.row(&Vec3::x), map.row(&Vec3::y), map.row(&Vec3::z)};
        plane_ = camera.projection([&](auto p) { return p.depth_plane(q, rows); });
    }

    // Returns the bound where |n − middle| ≤ half in both coordinates.
    double farthest(Vec2 middle, Vec2 half) const {
        if (!tilted_) return farthest_;
        const double value = middle.x * plane_.x + middle.y * plane_.y + plane_.z;
        const double change = half.x * std::fabs(plane_.x) + half.y * std::fabs(plane_.y);
        return camera_->projection([&](auto p) { return p.farthest(value, change, farthest_); });
    }

   private:
    const Camera* camera_ = nullptr;
    bool tilted_ = false;
    double farthest_ = 0;
    Vec3 plane_;  // affine function of h = (n, 1) that bounds it
};

// Returns the depth as a float, rounded up.
inline float rounded_up(double depth) {
    const float f = float(depth);
    return double(f) >= depth ? f : std::nextafter(f, std::numeric_limits<float>::infinity());
}

}  // namespace edgegrad
