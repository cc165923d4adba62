// What is seen at any places in the image, and the rays that go there, for shaders written in PyTorch.
#pragma once

#include <cstdint>
#include <vector>

#include "accumulate/records.h"
#include "camera/camera.h"
#include "core/parallel.h"
#include "rays/geometry.h"
#include "scene/scene.h"

namespace edgegrad {

// Positions x (N, 2) in the image, px.
struct Places {
    const double* x;
    int64_t size;

    Vec2 operator[](int64_t i) const { return {x[2 * i], x[2 * i + 1]}; }
};

struct PlaceHits {
    std::vector<int32_t> face;  // (N,) −1: none
    std::vector<int32_t> part;  // (N,) of the surface that is connected, −1: none
    std::vector<double> b;      // (N, 2) where on the face
};

// The geometry must have its parts.
template <class T>
PlaceHits hits_at(const SceneView<T>& scene, const Camera& camera, const Geometry& geometry, const Places& places,
                  ThreadTeam& team);

// Where the lens shows nothing, a ray holds NaN. Without `intrinsics` their derivatives are left out.
RayRecords rays_at(const Camera& camera, const Places& places, bool intrinsics, ThreadTeam& team);

}  // namespace edgegrad
