// Any rays through a scene, from where a user says: what they hit, and whether a point sees another. Embree says in
// float which face a ray may meet, double decides whether it does, and whether the face is there or masked by alpha.
#pragma once

#include <cstdint>
#include <vector>

#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"

namespace edgegrad {

// Origins and directions (N, 3).
struct TracedRays {
    const double *origins, *directions;
    int64_t size;
    const int32_t* ignored = nullptr;  // (N,) a face that each passes through, −1: none; null: none at all
};

struct RayHits {
    std::vector<int32_t> face;  // (N,) the nearest, −1: none
    std::vector<double> b;      // (N, 2) where on it
};
template <class T>
RayHits trace(const SceneView<T>& scene, const RayCaster& caster, const TracedRays& rays, ThreadTeam& team);

// N points on faces, and the points (N, 3) that they may see.
struct Sightlines {
    const int32_t* face;
    const double *b, *to;
    const double* contact;  // (N,) world units: what is nearer than this to either end hides nothing
    int64_t size;
};
// (N,): 1 where nothing lies between the two. The face of the point itself hides nothing.
template <class T>
std::vector<uint8_t> visible(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines,
                             ThreadTeam& team);
// The same on one thread.
template <class T>
void see(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines, uint8_t* out);

// N rays from points on faces (barycentrics (N, 2)) in unit directions (N, 3).
struct Departures {
    const int32_t* face;
    const double *b, *directions;
    const double* contact;  // (N,) world units: what is nearer than this to the point is not met
    int64_t size;
};
// The nearest face that each meets, −1: none, and where on it, (N, 2); on one thread. A ray does not meet the face that
// it leaves.
template <class T>
void depart(const SceneView<T>& scene, const RayCaster& caster, const Departures& rays, int32_t* face, double* b);

}  // namespace edgegrad
