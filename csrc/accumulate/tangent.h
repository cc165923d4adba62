// Implements forward mode: derivatives in given directions. Each sample adds to the pixels around it.
#pragma once

#include <span>
#include <vector>

#include "accumulate/gradients.h"
#include "accumulate/scatter.h"
#include "camera/sub_cameras.h"
#include "camera/vertices.h"
#include "film/film.h"

namespace edgegrad {

// Holds one direction: the tangents of the arrays, and of the vertices in the camera and its intrinsics.
struct Direction {
    Tangents tangents;
    Array<Vec3> q{0};  // (V,) camera coordinates; empty: nothing moves
    IntrinsicsGrad intrinsics{};

    bool moves() const { return !q.empty(); }
};

// Uses q = R p + t: q̇ = R ṗ + Ṙ p + ṫ.
inline Direction make_direction(const Tangents& tangents, const Camera& sub_camera, const double* verts,
                                int64_t n_verts, ThreadTeam& team) {
    Direction out{.tangents = tangents};
    if (!tangents.geometry()) return out;
    out.intrinsics = sub_camera_intrinsics(sub_camera, tangents.K, tangents.distortion);
    out.q = Array<Vec3>(n_verts);
    const auto at = [](const double* a) { return Vec3{a[0], a[1], a[2]}; };
    team.parallel_for_blocks(n_verts, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) {
            Vec3 q_dot;
            if (const double* dot = tangents.verts) q_dot += sub_camera.R * at(dot + 3 * v);
            if (const double* dot = tangents.world_to_camera) {
                const Vec3 p = at(verts + 3 * v);
                q_dot += sub_camera.rotation * Vec3{dot[0] * p.x + dot[1] * p.y + dot[2] * p.z + dot[3],
                                                    dot[4] * p.x + dot[5] * p.y + dot[6] * p.z + dot[7],
                                                    dot[8] * p.x + dot[9] * p.y + dot[10] * p.z + dot[11]};
            }
            out.q[v] = q_dot;
        }
    });
    return out;
}

using Directions = std::span<const Direction>;

// Adds numbers, (D, C) for D directions, to the pixels whose filter reaches a point.
class Splat {
   public:
    Splat(const FilteredPixels& pixels, RowBuffer& rows, int width) : pixels_(pixels), rows_(rows), weighted_(width) {}

    void add(Vec2 x, const std::vector<double>& values) {
        pixels_.around(x, [&](int64_t pixel, double weight) { add(pixel, weight, values); });
    }
    void add(int64_t pixel, double weight, const std::vector<double>& values) {
        for (size_t i = 0; i < values.size(); ++i) weighted_[i] = weight * values[i];
        rows_.add(pixel, weighted_.data());
    }

   private:
    const FilteredPixels pixels_;
    RowBuffer& rows_;
    std::vector<double> weighted_;
};

}  // namespace edgegrad
