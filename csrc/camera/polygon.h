// Clips a face to the view, and samples points on it.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>

#include "camera/face_map.h"
#include "camera/view_volume.h"
#include "core/sierpinski.h"

namespace edgegrad {

// Holds a convex polygon in the image.
struct VisiblePolygon {
    Vec2 corner[ViewVolume::most_corners + 2];
    int n = 0;
    // The first corner is then the polygon's nearest point to the camera's pole, which may lie within.
    bool starred = false;
    double area = 0;     // px²
    double longest = 0;  // px
    double nearest = 0;  // depth
    Vec2 low, high;

    // Sets the polygon of the face with the vertices v. Returns false when nothing is visible.
    bool set(const Camera& camera, const ViewVolume& volume, const VertexView& p, const int32_t* v) {
        const uint8_t c0 = p.outcode[v[0]], c1 = p.outcode[v[1]], c2 = p.outcode[v[2]];
        if (c0 & c1 & c2) return false;
        if (!(c0 | c1 | c2)) {
            n = 3;
            for (int i = 0; i < 3; ++i) corner[i] = p.x[v[i]];
            nearest = std::min({p.q[v[0]].z, p.q[v[1]].z, p.q[v[2]].z});
        } else {
            if (camera.facing(p.q[v[0]], p.q[v[1]], p.q[v[2]]) == 0) return false;
            Vec3 polygon[ViewVolume::most_corners] = {p.q[v[0]], p.q[v[1]], p.q[v[2]]};
            n = volume.clip_triangle(polygon);
            double least = std::numeric_limits<double>::infinity(), farthest = 0;
            nearest = least;
            for (int i = 0; i < n; ++i) {
                nearest = std::min(nearest, polygon[i].z);
                // Only a triangle through the eye has a corner there; it has no image to sample.
                least = std::min(least, camera.depth_weight(polygon[i]));
                if (!(least > 0)) return false;
                corner[i] = volume.inside(project(camera, polygon[i]));
            }
            if (n < 3) return false;
            for (int i = 0; i < 3; ++i) farthest = std::max(farthest, length(p.q[v[i]]));
            // A point between very distant corners is rounded as they are. If that shows, the polygon becomes the whole
            // view; samples that miss the face find nothing.
            if (!(std::numeric_limits<double>::epsilon() * farthest / least * camera.pixels_per_unit < 0.1)) {
                const Vec2 a = volume.low, b = volume.high, view[4] = {a, {b.x, a.y}, b, {a.x, b.y}};
                n = std::copy(view, view + 4, corner) - corner;
            }
        }
        area = 0;
        low = high = corner[0];
        double longest_squared = 0;
        for (int i = 0; i < n; ++i) {
            const Vec2 a = corner[i], b = corner[i + 1 < n ? i + 1 : 0], side = b - a;
            longest_squared = std::max(longest_squared, side.x * side.x + side.y * side.y);
            low = {std::min(low.x, a.x), std::min(low.y, a.y)};
            high = {std::max(high.x, a.x), std::max(high.y, a.y)};
            if (i >= 2) area += 0.5 * std::fabs(wedge(corner[i - 1] - corner[0], a - corner[0]));
        }
        longest = std::sqrt(longest_squared);
        starred = false;
        if (const std::optional<Vec2> pole = camera.pole(); pole && area > 0) star(*pole);
        return area > 0;
    }

   private:
    // Makes the point nearest to the pole the first corner, unless all corners are about as far away.
    void star(Vec2 pole) {
        int side = 0, inside = 0;
        double least = std::numeric_limits<double>::infinity(), most = 0;
        Vec2 nearest;
        for (int i = 0; i < n; ++i) {
            const Vec2 a = corner[i], along = corner[i + 1 < n ? i + 1 : 0] - a, to = pole - a;
            const double squared = along.x * along.x + along.y * along.y;
            const double t = squared > 0 ? std::clamp((along.x * to.x + along.y * to.y) / squared, 0.0, 1.0) : 0;
            const double distance = length(to - t * along);
            if (distance < least) least = distance, nearest = a + t * along, side = i;
            most = std::max(most, length(to));
            inside += wedge(along, to) > 0 ? 1 : -1;
        }
        if (std::abs(inside) == n) least = 0, nearest = pole;
        if (!(4 * least < most)) return;
        Vec2 out[ViewVolume::most_corners + 2];
        int m = 0;
        out[m++] = nearest;
        for (int i = 1; i <= n; ++i) out[m++] = corner[(side + i) % n];
        if (std::abs(inside) == n) out[m++] = out[1];
        n = std::copy(out, out + m, corner) - corner;
        starred = true;
    }
};

// Samples points uniformly over a polygon, along a curve that fills one triangle after the other. A starred polygon has
// a density of 1 / distance to its first corner in each triangle, as areas grow there. No point of a convex polygon is
// nearer to the pole than to its own nearest point to the pole.
class PolygonSampler {
   public:
    // Prepares for about n points.
    void set(const VisiblePolygon& polygon, double n) {
        polygon_ = &polygon, n_ = n, triangle_ = 0, end_ = 0, weight_ = 1;
    }

    // Returns a point: s in [0, 1) runs along the curve, and u is a point of the unit square. Ascending s is fast.
    Vec2 operator()(double s, Vec2 u) {
        const Vec2* corner = polygon_->corner;
        while (triangle_ < 2 || (s >= end_ && triangle_ + 1 < polygon_->n)) {
            triangle_ = std::max(2, triangle_ + 1);
            begin_ = end_;
            const double area =
                0.5 * std::fabs(wedge(corner[triangle_ - 1] - corner[0], corner[triangle_] - corner[0]));
            share_ = area / polygon_->area, end_ = begin_ + share_;
            // Two to four cells per point give each point its own cell.
            const double cells = std::clamp(2 * n_ * share_, 1.0, double(1u << SierpinskiCurve::most_levels));
            levels_ = std::bit_width(uint32_t(std::ceil(cells)) - 1);
            curve_.set({1, 0}, {0, 0}, {0, 1}, levels_);
        }
        const double t = share_ > 0 ? std::clamp((s - begin_) / share_, 0.0, 1 - 0x1p-53) : 0;
        const Vec2 p = curve_.point(uint32_t(t * (1u << levels_)), u);
        lambda_ = {p.x, p.y};
        // The triangle is scaled from its first corner. Let ρ = x + y be the fraction of the way to the far side. For a
        // uniform point, ρ has a density of 2 ρ, and its square is uniform.
        const Vec2 e1 = corner[triangle_ - 1] - corner[0], e2 = corner[triangle_] - corner[0];
        if (!polygon_->starred) return corner[0] + p.x * e1 + p.y * e2;
        const double rho = p.x + p.y;
        weight_ = 2 * rho * rho;
        return corner[0] + rho * (p.x * e1 + p.y * e2);
    }

    // Returns the last point's barycentrics in its triangle, if the polygon is not starred.
    Barycentrics lambda() const { return lambda_; }
    // Returns the mean density of points over the density at the last one.
    double weight() const { return weight_; }

   private:
    const VisiblePolygon* polygon_ = nullptr;
    double n_ = 0, begin_ = 0, end_ = 0, share_ = 0;
    int triangle_ = 0, levels_ = 0;
    SierpinskiCurve curve_;
    Barycentrics lambda_;
    double weight_ = 1;
};

}  // namespace edgegrad
