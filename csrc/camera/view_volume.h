// Bounds the visible part of the scene by planes through the borders of the image, and clips against them.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "camera/camera.h"

namespace edgegrad {

// Bounds the visible rectangle of the undistorted image, widened by the radius of the pixel filter. Its four planes n ·
// q + d ≥ 0 pass through the camera and the rectangle's sides. Whatever lies inside all of them is in front of the
// camera, because adding opposite planes gives Z · width ≥ 0. No near plane is needed.
struct ViewVolume {
    Vec3 normal[4];
    double offset[4];
    Vec2 low, high;   // bounds of the rectangle
    double least[4];  // lower bound of the distance to each plane: zero, or more where the plane belongs to a neighbour

    ViewVolume(const Camera& c, double margin) : low{-margin, -margin}, high{c.width + margin, c.height + margin} {
        if (!c.is_undistorted()) low = c.lens_view.low, high = c.lens_view.high;
        const double bound[4] = {low.x, high.x, low.y, high.y};
        for (int i = 0; i < 4; ++i) {
            const double* row = c.k + (i < 2 ? 0 : 3);
            const double sign = i % 2 ? -1.0 : 1.0, constant = sign * (row[2] - bound[i]);
            normal[i] = {sign * row[0], sign * row[1], c.perspective ? constant : 0.0};
            offset[i] = c.perspective ? 0.0 : constant;
            least[i] = c.lens_view.open[i] ? std::numeric_limits<double>::denorm_min() : 0.0;
        }
    }

    double distance(int plane, Vec3 q) const { return dot(normal[plane], q) + offset[plane]; }

    // Returns a code whose bit i is set outside plane i.
    uint8_t outcode(Vec3 q) const {
        uint8_t code = 0;
        for (int i = 0; i < 4; ++i) code |= (distance(i, q) < least[i]) << i;
        return code;
    }

    // Returns the nearest point in the rectangle, because rounding may leave clipped points outside.
    Vec2 inside(Vec2 x) const { return {std::clamp(x.x, low.x, high.x), std::clamp(x.y, low.y, high.y)}; }

    // Finds the part [t0, t1] of the segment (1 − t) a + t b that lies inside. Returns false when there is none.
    bool clip_segment(Vec3 a, Vec3 b, double& t0, double& t1) const {
        t0 = 0, t1 = 1;
        for (int i = 0; i < 4; ++i) {
            const double da = distance(i, a), db = distance(i, b);
            if (da < least[i] && db < least[i]) return false;
            if (da < 0) t0 = std::fmax(t0, da / (da - db));
            if (db < 0) t1 = std::fmin(t1, da / (da - db));
        }
        return t0 < t1;
    }

    // Clips a triangle in place (Sutherland and Hodgman 1974). Returns the number of corners. A plane adds one corner
    // to a convex polygon. Where corners lie on a plane up to rounding, their signs may alternate, and the number may
    // double. Such a polygon is convex up to rounding, too, so it only needs space.
    static constexpr int most_corners = 3 << 4;
    int clip_triangle(Vec3* polygon) const {
        int n = 3;
        for (int i = 0; i < 4 && n > 0; ++i) {
            Vec3 out[most_corners];
            int m = 0;
            for (int j = 0; j < n; ++j) {
                const Vec3 p = polygon[j], r = polygon[(j + 1) % n];
                const double dp = distance(i, p), dr = distance(i, r);
                if (dp >= 0) out[m++] = p;
                if ((dp >= 0) != (dr >= 0)) out[m++] = p + (dp / (dp - dr)) * (r - p);
            }
            n = m;
            for (int j = 0; j < n; ++j) polygon[j] = out[j];
        }
        return n;
    }
};

}  // namespace edgegrad
