// Traces light that has reached points of surfaces on to the camera (light tracing; Dutré, Lafortune and Willems 1993).
// Each point scatters it into a sampled direction, and each point that is hit connects to the camera if nothing
// occludes it. Curves that the camera does not see directly need this, because paths from pixels do not find them.
//
// Let B_k arrive at a point x_k from the unit direction i. With the normals n for shading and g of the face, and the
// terminator t (terminator()), the point sends
//
//     f(i → e) B_k t (n · i) / |g · i| · |∂x/∂A|       to the camera in the direction e, per px²,
//     B_{k+1} = f(i → w) B_k t (n · i) / |g · i| · |g · w| / p(w)     to the point that the direction w hits,
//
// with the pdf p with respect to solid angle. B is radiance times an area across the ray: light of the radiance L
// through a projected area |g · i| dA carries B = L |g · i| dA. The quotients are those of shading normals (Veach
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

// Holds points of faces that light has reached.
struct Arrivals {
    int64_t size;
    const int64_t* face;
    const double* b;        // (N, 3) barycentrics
    const double* from;     // (N, 3) unit directions from which it came
    const double* carried;  // (N, channels)
    const int64_t* seed;    // (N,) seeds of random numbers

    Arrivals part(int64_t first, int64_t count, int channels) const {
        return {std::min(count, size - first), face + first, b + 3 * first, from + 3 * first,
                carried + channels * first,    seed + first};
    }
};

// Holds connections to the image, at most one after each step.
struct Connections {
    std::vector<int64_t> arrival;  // (M,) the arrival of each
    std::vector<double> x;         // (M, 2) pixel positions
    std::vector<double> radiance;  // (M, channels) added radiance times px²
};

// Selects the steps after which paths connect to the camera: first, …, last. With `first` = 0, the arrivals themselves
// connect, too. Results are in the order of blocks of arrivals.
struct StepRange {
    int first, last;
};
template <class T>
std::vector<Connections> towards_camera(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                                        const CameraConnections& camera, const Arrivals& arrivals, StepRange steps,
                                        ThreadTeam& team);

}  // namespace edgegrad
