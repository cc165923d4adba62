// Where Embree's floats lie in the world.
#pragma once

#include <cstdint>
#include <vector>

#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// The frame in which Embree sees the scene: (p − centre) / unit, where all of it lies within `radius` of the origin.
struct RayFrame {
    Vec3 centre;
    double unit = 1, radius = 1;

    Vec3 position(Vec3 p) const { return (1 / unit) * (p - centre); }

    // Whether floats around o, a position in the frame, would be coarser than the scene.
    bool is_far(Vec3 o) const { return length(o) > 4 * radius; }

    // How far along o + t d a ray may start instead: just before the ball in which everything lies.
    double start(Vec3 o, Vec3 d) const { return -dot(o, d) / dot(d, d) - 2 * radius; }
};

// That of the faces (F, 3) with vertices (V, 3), of which `used` (V,) says whether a face has them; all have one if it
// is empty. Throws std::invalid_argument if floats cannot hold the faces together.
struct PlacedTriangles {
    const int32_t* faces;
    int64_t n_faces;
    const double* verts;
    int64_t n_verts;
    const std::vector<uint8_t>& used;
};
RayFrame frame_of(const PlacedTriangles& triangles, ThreadTeam& team);

}  // namespace edgegrad
