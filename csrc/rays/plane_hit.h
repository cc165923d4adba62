// Decides in double what a ray truly hits; Embree proposes faces in float.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "rays/raycast.h"
#include "scene/scene.h"

namespace edgegrad {

inline Vec3 vec(const double* v) { return {v[0], v[1], v[2]}; }

// Returns a corner in world coordinates.
template <class T>
Vec3 corner(const SceneView<T>& scene, int64_t face, int i) {
    return vec(scene.verts + 3 * int64_t(scene.faces[3 * face + i]));
}

// Holds where a ray meets the plane of a face: barycentrics, and the distance in lengths of its direction (Möller and
// Trumbore 1997). They are NaN or infinite where the ray runs along the plane.
struct PlaneHit {
    double u, v, t;

    // Doubles cannot distinguish less than this from the border of a face.
    static constexpr double rounding = 1e-12;

    bool exists() const { return std::isfinite(u + v + t); }
    // Returns the least barycentric, which is negative outside of the face.
    double margin() const { return std::min({u, v, 1 - u - v}); }
    // Returns whether the point lies within the face, to double precision.
    bool inside() const { return margin() >= -rounding; }
};
template <class T>
PlaneHit intersect_plane(const SceneView<T>& scene, int64_t face, const Ray& ray) {
    const Vec3 q0 = corner(scene, face, 0), e1 = corner(scene, face, 1) - q0, e2 = corner(scene, face, 2) - q0,
               s = ray.origin - q0;
    const Vec3 p = cross(ray.direction, e2), q = cross(s, e1);
    const double scale = 1 / dot(e1, p);
    return {dot(s, p) * scale, dot(ray.direction, q) * scale, dot(e2, q) * scale};
}

// Casts n rays, at most a batch. It casts each again without the faces that `accept(i, face)` rejects, until it accepts
// one or none is left, when `face` is −1. `without[i]` holds the faces that ray i ignores, ascending, and receives the
// rejected ones.
template <class MakeRay, class Accept>
void cast_each(const RayCaster& caster, int n, int32_t* face, std::vector<int32_t>* without, MakeRay make,
               Accept accept) {
    std::vector<int> open(n);
    for (int i = 0; i < n; ++i) open[i] = i, face[i] = -1;
    RayBatch batch;
    RayCaster::Ignored ignored[RayBatch::size];
    while (!open.empty()) {
        batch.count = int(open.size());
        for (int k = 0; k < batch.count; ++k)
            batch.set(k, caster.frame(), make(open[k])), ignored[k] = without[open[k]];
        caster.cast(batch, ignored);
        std::vector<int> again;
        for (int k = 0; k < batch.count; ++k) {
            const int i = open[k];
            if (batch.face[k] < 0) continue;
            if (accept(i, batch.face[k])) {
                face[i] = batch.face[k];
                continue;
            }
            without[i].insert(std::upper_bound(without[i].begin(), without[i].end(), batch.face[k]), batch.face[k]);
            again.push_back(i);
        }
        open = std::move(again);
    }
}

}  // namespace edgegrad
