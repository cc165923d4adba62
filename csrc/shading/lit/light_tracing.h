// Light that has come to points of surfaces, followed on to the camera: each point scatters it into a direction that is
// drawn, and each that a direction meets sends some to the camera, where nothing hides it (light tracing; Dutré,
// Lafortune and Willems 1993). It is what those curves need that the camera does not see: paths back from pixels do not
// come upon them.
//
// A point x_k to which B_k comes from the unit direction i sends, with the normals n for shading and g of the face, and
// the terminator t (terminator()),
//
//     f(i → e) B_k t (n · i) / |g · i| · |∂x/∂A|       to the camera in the direction e, per px²,
//     B_{k+1} = f(i → w) B_k t (n · i) / |g · i| · |g · w| / p(w)     to the point that the direction w meets,
//
// drawn with the pdf p by solid angle. B is radiance times an area across the ray: what light of the radiance L
// brings through a projected area |g · i| dA has B = L |g · i| dA. The quotients are those of shading normals (Veach
// 1996).
#pragma once

#include <cstdint>
#include <vector>

#include "camera/connection.h"
#include "core/parallel.h"
#include "rays/raycast.h"
#include "scene/scene.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

// Points of faces to which light has come.
struct Arrivals {
    int64_t size;
    const int64_t* face;
    const double* b;        // (N, 3) barycentrics
    const double* from;     // (N, 3) unit directions where it came from
    const double* carried;  // (N, channels)
    const int64_t* seed;    // (N,) of random numbers

    Arrivals part(int64_t first, int64_t count, int channels) const {
        return {std::min(count, size - first), face + first, b + 3 * first, from + 3 * first,
                carried + channels * first,    seed + first};
    }
};

// What comes to the image of it, at most one place after each step.
struct Connections {
    std::vector<int64_t> arrival;  // (M,) of which it is
    std::vector<double> x;         // (M, 2) pixel positions
    std::vector<double> radiance;  // (M, channels) that it adds there, times px²
};

// After first, first + 1, …, last steps, with `first` at least 0: then also the points themselves send light to the
// camera. In order of blocks of arrivals.
struct StepRange {
    int first, last;
};
template <class T>
std::vector<Connections> towards_camera(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                                        const CameraConnections& camera, const Arrivals& arrivals, StepRange steps,
                                        ThreadTeam& team);

}  // namespace edgegrad
