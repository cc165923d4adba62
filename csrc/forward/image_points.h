// Finds what is seen at any points of the image, and the rays to them, for shaders written in PyTorch.
#pragma once

#include <cstdint>
#include <vector>

#include "accumulate/records.h"
#include "camera/camera.h"
#include "core/parallel.h"
#include "rays/geometry.h"
#include "scene/scene.h"

namespace edgegrad {

// Holds positions x (N, 2) in the image, px.
struct ImagePoints {
    const double* x;
    int64_t size;

    Vec2 operator[](int64_t i) const { return {x[2 * i], x[2 * i + 1]}; }
};

struct ImagePointHits {
    std::vector<int32_t> face;  // (N,) −1: none
    std::vector<int32_t> part;  // (N,) the connected part (ConnectedParts), −1: none
    std::vector<double> b;      // (N, 2) last two barycentrics
};

// Requires geometry with its parts.
template <class T>
ImagePointHits hits_at(const SceneView<T>& scene, const Camera& camera, const Geometry& geometry,
                       const ImagePoints& points, ThreadTeam& team);

// Where the lens shows nothing, a ray is NaN. Derivatives need `intrinsics`.
RayRecords rays_at(const Camera& camera, const ImagePoints& points, bool intrinsics, ThreadTeam& team);

}  // namespace edgegrad
