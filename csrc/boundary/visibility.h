// Whether a face hides a point of a curve, decided in double. Embree decides in float which faces a ray meets, and near
// a curve that is not enough: the ray runs along the border of what it is to find.
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

    // False if a face that the ray meets hides the point; else it lies behind, and is kept if it is the nearest so far.
    bool lies_behind(int64_t face, const CurveFaces& own, CurveSample& sample) const {
        const auto corner = corners_of(view_, face);
        if (lies_far_before(view_, face, sample.point.z) || hides(face, corner.data(), sample.point, own)) return false;
        const double depth = depth_of(view_, face, sample.sight);
        if (depth < sample.behind.depth)
            sample.behind = {face, barycentrics_of_hit(face_map(view_.camera, corner.data()), sample.sight), depth};
        return true;
    }

    // The face that a ray truly meets, where `face` is what the cast found. Float and double may place the ray on
    // different sides of an edge between two faces that it runs through, and where that edge lies on the curve in the
    // image (the diagonal of a box's front, before an edge of its back) they do so again and again. Then float misses
    // the neighbour that double would meet; so next to the ray that passes through the refused face go others that are
    // moved off that face: by as much as floats may err, and by less, for the neighbour may be narrower than that.
    int32_t beyond_float(const CurveSample& sample, int32_t face) const {
        const Vec2 n = sample.sight;
        const auto decide = [&](int32_t f) {
            return lies_far_before(view_, f, sample.point.z) ? is_there(view_, f, n) : meets(view_, f, n);
        };
        if (face < 0 || decide(face)) return face;
        std::vector<int32_t> ignored(sample.ignored.begin(), sample.ignored.end());
        int32_t nearest = -1;
        double depth = std::numeric_limits<double>::infinity();
        for (int refused = 0; face >= 0 && !decide(face); ++refused) {
            // Where floats see hundreds of faces in one place, one ray decides on all of them.
            if (refused == most_refused) {
                face = view_.frame.beyond_float(n, face, ignored, decide);
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

    // Whether a face that the ray meets lies before the point: its plane has the point on one side and the viewer on
    // the other. Surfaces that touch at the curve (a cube on the ground) are not before it, however flat the view: the
    // point may lie behind the plane by what the rounding of the input leaves, some spacings of the coordinates there,
    // and by what doubles leave of a plane of that size, some of theirs. Faces that share vertices with those of the
    // curve (the front of a thin plate, for its back) are no other surface that touches: the input says how they lie.
    bool hides(int64_t face, const Vec3 corner[3], Vec3 point, const CurveFaces& own) const {
        const Vec3 normal = cross(corner[1] - corner[0], corner[2] - corner[0]);
        const Vec3 to_viewer = view_.camera.to_viewer(corner[0]);
        const double viewer = dot(normal, to_viewer), behind = dot(normal, point - corner[0]) * (viewer > 0 ? -1 : 1);
        double size = 0;
        for (int i = 0; i < 3; ++i)
            size = std::max({size, std::fabs(corner[i].x), std::fabs(corner[i].y), std::fabs(corner[i].z)});
        const double apart = behind / length(normal), rounding = rounding_of_doubles * size;
        // Of the two meshes, the coarser one's numbers count.
        const double coarser = std::max(own.spacing, view_.scene.spacing->of(view_.scene.faces[3 * face]));
        return apart > rounding && (apart > contact(coarser, own.coordinate, size) || shares_vertex(face, own.faces));
    }

    bool shares_vertex(int64_t face, std::span<const int32_t> others) const {
        return std::any_of(others.begin(), others.end(), [&](int32_t f) { return share_vertex(view_.scene, face, f); });
    }

    // The way from n, which a face does not cover, across the side that it lies beyond: as long as floats may err.
    Vec2 out_of(int64_t face, Vec2 n) const {
        const FaceMap m = face_map(view_.camera, corners_of(view_, face).data());
        const Vec3 p = m.times(n);
        const double sign = p.z < 0 ? -1 : 1;
        // Barycentrics times p.z, as affine functions of n: value and slope.
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
