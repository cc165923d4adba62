// This file decides in double precision whether a face occludes a point of a curve. Embree intersects in single
// precision, which does not suffice near a curve: the ray runs along the borders of the faces that it must find.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "boundary/curve_source.h"
#include "estimator/near_misses.h"
#include "estimator/view.h"
#include "scene/contact.h"

namespace edgegrad {

template <class T>
class Visibility {
   public:
    explicit Visibility(const BackwardView<T>& view) : view_(view) {}

    // Returns false if a face that the ray meets occludes the point. Otherwise stores it if it is the nearest behind.
    bool lies_behind(int64_t face, const CurveFaces& own, CurveSample& sample) const {
        const auto corner = corners_of(view_, face);
        if (lies_far_before(view_, face, sample.point.z) || hides(face, corner.data(), sample.point, own)) return false;
        const double depth = depth_of(view_, face, sample.sight);
        if (depth < sample.behind.depth)
            sample.behind = {face, barycentrics_of_hit(face_map(view_.camera, corner.data()), sample.sight), depth};
        return true;
    }

    // Returns the face that a ray truly meets, if the cast found `face`. Single and double precision may place the ray
    // on different sides of an edge between two faces. Where that edge lies on the curve in the image, they do so
    // repeatedly. An example is the diagonal of a box's front before an edge of its back. A ray that ignores the
    // refused face then misses the neighbour in single precision. Further rays are therefore moved off that face, by
    // the error of floats and by less, because the neighbour may be narrower than that.
    int32_t exact_hit(const CurveSample& sample, int32_t face) const {
        const Vec2 n = sample.sight;
        const auto decide = [&](int32_t f) {
            return lies_far_before(view_, f, sample.point.z) ? is_there(view_, f, n) : meets(view_, f, n);
        };
        if (face < 0 || decide(face)) return face;
        std::vector<int32_t> ignored(sample.ignored.begin(), sample.ignored.end());
        int32_t nearest = -1;
        double depth = std::numeric_limits<double>::infinity();
        for (int refused = 0; face >= 0 && !decide(face); ++refused) {
            // One ray decides on all faces where floats see hundreds of them in one place.
            if (refused == most_refused) {
                face = view_.frame.exact_hit(n, face, ignored, decide);
                break;
            }
            const Vec2 error = out_of(face, n);
            ignored.insert(std::upper_bound(ignored.begin(), ignored.end(), face), face);
            face = each_near_miss(view_, n, error, ignored, [&](int32_t met) {
                if (!decide(met)) return;
                if (const double z = depth_of(view_, met, n); z < depth) nearest = met, depth = z;
            });
        }
        return face >= 0 && depth_of(view_, face, n) < depth ? face : nearest;
    }

   private:
    static constexpr int most_refused = 3;

    // Returns whether a face that the ray meets occludes the point: its plane separates the point from the viewer.
    // Surfaces that touch at the curve (a cube on the ground) do not occlude it, however grazing the view. The point
    // may lie behind the plane by some spacings of the input's coordinates, and by the rounding of doubles. Faces that
    // share vertices with those of the curve are exempt from contact, because the input determines their position. An
    // example is the front of a thin plate, for its back.
    bool hides(int64_t face, const Vec3 corner[3], Vec3 point, const CurveFaces& own) const {
        const Vec3 normal = cross(corner[1] - corner[0], corner[2] - corner[0]);
        const Vec3 to_viewer = view_.camera.to_viewer(corner[0]);
        const double viewer = dot(normal, to_viewer), behind = dot(normal, point - corner[0]) * (viewer > 0 ? -1 : 1);
        double size = 0;
        for (int i = 0; i < 3; ++i)
            size = std::max({size, std::fabs(corner[i].x), std::fabs(corner[i].y), std::fabs(corner[i].z)});
        const double apart = behind / length(normal), rounding = rounding_of_doubles * size;
        // The coarser mesh determines the spacing.
        const double coarser = std::max(own.spacing, view_.scene.spacing->of(view_.scene.faces[3 * face]));
        return apart > rounding && (apart > contact(coarser, own.coordinate, size) || shares_vertex(face, own.faces));
    }

    bool shares_vertex(int64_t face, std::span<const int32_t> others) const {
        return std::any_of(others.begin(), others.end(), [&](int32_t f) { return share_vertex(view_.scene, face, f); });
    }

    // Returns the vector from n, outside a face, away from it across the nearest side, as long as the error of floats.
    Vec2 out_of(int64_t face, Vec2 n) const {
        const FaceMap m = face_map(view_.camera, corners_of(view_, face).data());
        const Vec3 p = m.times(n);
        const double sign = p.z < 0 ? -1 : 1;
        // Barycentrics times p.z are affine functions of n, stored as slope and value.
        const auto row = [&](double Vec3::* r) { return Vec3{m.column[0].*r, m.column[1].*r, p.*r}; };
        const Vec3 u = row(&Vec3::x), v = row(&Vec3::y), w = row(&Vec3::z);
        Vec2 away;
        double farthest = -std::numeric_limits<double>::infinity();
        for (const Vec3 b : {u, v, w - u - v}) {
            const double slope = length(Vec2{b.x, b.y}), distance = -sign * b.z / slope;
            if (slope > 0 && distance > farthest) farthest = distance, away = (-sign / slope) * Vec2{b.x, b.y};
        }
        double error = 0;
        for (int i = 0; i < 3; ++i) {
            const double* q = view_.scene.verts + 3 * int64_t(view_.scene.faces[3 * int64_t(face) + i]);
            error = std::max(error, view_.frame.error({q[0], q[1], q[2]}));
        }
        return (error / view_.camera.unit_at_depth(depth_of(view_, face, n))) * away;
    }

    const BackwardView<T>& view_;
};

}  // namespace edgegrad
