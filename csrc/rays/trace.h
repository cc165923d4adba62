// Traces rays of any origin through a scene, and tests the visibility between points. Embree proposes hits in float;
// double decides about them, and about alpha-tested faces.
#pragma once

#include <cstdint>
#include <vector>

#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"

namespace edgegrad {

// Holds origins and directions (N, 3).
struct TracedRays {
    const double *origins, *directions;
    int64_t size;
    const int32_t* ignored = nullptr;  // (N,) a face that each ray ignores, −1: none; null: none at all
};

struct RayHits {
    std::vector<int32_t> face;  // (N,) the nearest face, −1: none
    std::vector<double> b;      // (N, 2) last two barycentrics
};
template <class T>
RayHits trace(const SceneView<T>& scene, const RayCaster& caster, const TracedRays& rays, ThreadTeam& team);

// Holds N points on faces, and the points (N, 3) that they may see.
struct Sightlines {
    const int32_t* face;
    const double *b, *to;
    const double* contact;  // (N,) world units: anything nearer than this to either end does not occlude
    int64_t size;
};
// Returns (N,): 1 where nothing occludes the two points from each other. The point's own face does not occlude.
template <class T>
std::vector<uint8_t> visible(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines,
                             ThreadTeam& team);
// Does the same on one thread.
template <class T>
void test_visibility(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines, uint8_t* out);

// Holds N rays from points on faces (barycentrics (N, 2)) in unit directions (N, 3).
struct SurfaceRays {
    const int32_t* face;
    const double *b, *directions;
    const double* contact;  // (N,) world units: anything nearer than this to the point is not hit
    int64_t size;
};
// Finds the nearest face that each ray hits, −1: none, and its barycentrics (N, 2), on one thread. A ray does not hit
// the face that it leaves.
template <class T>
void trace_from_surface(const SceneView<T>& scene, const RayCaster& caster, const SurfaceRays& rays, int32_t* face,
                        double* b);

}  // namespace edgegrad
