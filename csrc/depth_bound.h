// Between which depths what is hit in a pixel lies: bounds for one face, kept for the backward pass as those of a
// pixel. What lies behind them in every pixel that it touches is most likely occluded, and what they do not lie before
// is most likely visible (occlusion.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "surface.h"

namespace edgegrad {

// The depth of one face within a pixel. Along the plane of a face 1/z is affine in the normalised image coordinates n
// of a perspective view, for N · (z h) = N · q0 with h = (n.x, n.y, 1); in an orthographic view z itself is.
class DepthBound {
   public:
    void set(const Camera& camera, const Vec3 q[3], const FaceMap& map) {
        const auto [low, high] = std::minmax({q[0].z, q[1].z, q[2].z});
        perspective_ = camera.perspective, nearest_ = low, farthest_ = high;
        // A face whose depth changes by no more than two pixels' width needs no plane: its corners will do.
        const double width = 2 / camera.pixels_per_unit;
        tilted_ = !(high - low <= width * (perspective_ ? low : 1.0));
        if (!tilted_) return;
        plane_ = plane(camera, q, map);
    }

    // Widens a range of depths by those where |n − middle| ≤ half in either coordinate.
    void widen(Vec2 middle, Vec2 half, double& nearest, double& farthest) const {
        double low = nearest_, high = farthest_;
        if (tilted_) {
            const double value = middle.x * plane_.x + middle.y * plane_.y + plane_.z;
            const double change = half.x * std::fabs(plane_.x) + half.y * std::fabs(plane_.y);
            // With NaN, or beyond the horizon, the plane is no bound.
            if (!perspective_) low = std::fmax(low, value - change), high = std::fmin(high, value + change);
            else if (value > change)
                low = std::fmax(low, 1 / (value + change)), high = std::fmin(high, 1 / (value - change));
        }
        nearest = std::min(nearest, low), farthest = std::max(farthest, high);
    }

    // The least depth of the plane of a face with these corners where |n − middle| ≤ half, beyond the face too; −∞
    // where the plane comes to the eye.
    static double nearest_on_plane(const Camera& camera, const Vec3 q[3], Vec2 middle, Vec2 half) {
        const Vec3 a = plane(camera, q, face_map(camera, q));
        const double value = middle.x * a.x + middle.y * a.y + a.z,
                     change = half.x * std::fabs(a.x) + half.y * std::fabs(a.y);
        const double low = !camera.perspective ? value - change : value > change ? 1 / (value + change) : -1;
        return std::isfinite(low) ? low : -std::numeric_limits<double>::infinity();
    }

   private:
    // Of 1/z in perspective, z in an orthographic view, as a function of h.
    static Vec3 plane(const Camera& camera, const Vec3 q[3], const FaceMap& map) {
        const Vec3* c = map.column;
        // M = (U, V, D) row by row, with D = −N and (u, v) = (U · h, V · h) / D · h.
        const auto row = [&](double Vec3::* r) { return Vec3{c[0].*r, c[1].*r, c[2].*r}; };
        const Vec3 U = row(&Vec3::x), V = row(&Vec3::y), D = row(&Vec3::z);
        if (camera.perspective) return (1 / dot(q[0], D)) * D;
        return (1 / D.z) * ((q[1].z - q[0].z) * U + (q[2].z - q[0].z) * V) + Vec3{0, 0, q[0].z};
    }

    bool perspective_ = true, tilted_ = false;
    double nearest_ = 0, farthest_ = 0;
    Vec3 plane_;
};

// A depth as a float that is no larger, or no smaller.
inline float rounded_down(double depth) {
    const float f = float(depth);
    return double(f) <= depth ? f : std::nextafter(f, -std::numeric_limits<float>::infinity());
}
inline float rounded_up(double depth) { return -rounded_down(-depth); }

}  // namespace edgegrad
