// How far away what is hit in a pixel lies: a bound for one face, kept for the backward pass as that of a pixel. What
// lies behind it in every pixel that it touches is most likely occluded (occlusion.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "shading/surface.h"

namespace edgegrad {

// The depth of one face within a pixel. Along the plane of a face 1/z is affine in the normalised image coordinates n
// of a perspective view, for N · (z h) = N · q0 with h = (n.x, n.y, 1); in an orthographic view z itself is.
class DepthBound {
   public:
    void set(const Camera& camera, const Vec3 q[3], const FaceMap& map) {
        const auto [low, high] = std::minmax({q[0].z, q[1].z, q[2].z});
        perspective_ = camera.perspective, farthest_ = high;
        // A face whose depth changes by no more than two pixels' width needs no plane: its corners will do.
        const double width = 2 / camera.pixels_per_unit;
        tilted_ = !(high - low <= width * (perspective_ ? low : 1.0));
        if (!tilted_) return;
        const Vec3* c = map.column;
        // M = (U, V, D) row by row, with D = −N and (u, v) = (U · h, V · h) / D · h.
        const auto row = [&](double Vec3::* r) { return Vec3{c[0].*r, c[1].*r, c[2].*r}; };
        const Vec3 U = row(&Vec3::x), V = row(&Vec3::y), D = row(&Vec3::z);
        plane_ = perspective_ ? (1 / dot(q[0], D)) * D
                              : (1 / D.z) * ((q[1].z - q[0].z) * U + (q[2].z - q[0].z) * V) + Vec3{0, 0, q[0].z};
    }

    // Where |n − middle| ≤ half in either coordinate.
    double farthest(Vec2 middle, Vec2 half) const {
        if (!tilted_) return farthest_;
        const double value = middle.x * plane_.x + middle.y * plane_.y + plane_.z;
        const double change = half.x * std::fabs(plane_.x) + half.y * std::fabs(plane_.y);
        // With NaN, or beyond the horizon, the plane is no bound.
        if (!perspective_) return std::fmin(farthest_, value + change);
        return value > change ? std::fmin(farthest_, 1 / (value - change)) : farthest_;
    }

   private:
    bool perspective_ = true, tilted_ = false;
    double farthest_ = 0;
    Vec3 plane_;  // of 1/z in perspective, z in an orthographic view, as a function of h
};

// A depth as a float that is no smaller.
inline float rounded_up(double depth) {
    const float f = float(depth);
    return double(f) >= depth ? f : std::nextafter(f, std::numeric_limits<float>::infinity());
}

}  // namespace edgegrad
