// The vertices of a scene before one camera.
#pragma once

#include <cstdint>

#include "camera/camera.h"
#include "camera/view_volume.h"
#include "core/array.h"
#include "core/parallel.h"

namespace edgegrad {

// Everything about the vertices that one camera needs: camera coordinates, pixel position, and on which side of the
// view volume. The pixel position holds only where the outcode is zero.
struct VertexView {
    Array<Vec3> q;
    Array<Vec2> x;
    Array<uint8_t> outcode;

    static constexpr int64_t bytes_per_vertex = sizeof(Vec3) + sizeof(Vec2) + sizeof(uint8_t);
};

// Vertex v of `verts` (V, 3) in camera coordinates.
inline Vec3 camera_vertex(const Camera& camera, const double* verts, int64_t v) {
    return camera.to_camera({verts[3 * v], verts[3 * v + 1], verts[3 * v + 2]});
}

inline Array<Vec3> camera_vertices(const Camera& camera, const double* verts, int64_t n, ThreadTeam& team) {
    Array<Vec3> q(n);
    team.parallel_for_blocks(n, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) q[v] = camera_vertex(camera, verts, v);
    });
    return q;
}

VertexView view_vertices(const Camera& camera, const ViewVolume& volume, const double* verts, int64_t n,
                         ThreadTeam& team);

}  // namespace edgegrad
