#include "camera/vertices.h"

namespace edgegrad {

namespace {

// Vertices side by side, so that loops over them become vectors.
struct VertexLanes {
    static constexpr int size = 32;
    double p[3][size] = {}, q[3][size], x[2][size];
    int32_t outcode[size];
};

// As Camera::to_camera, ViewVolume::outcode and project() have it, in the same order of operations.
EDGEGRAD_VECTORIZED void view_lanes(VertexLanes& l, const Camera& camera, const ViewVolume& volume) {
    constexpr int lanes = VertexLanes::size;
    const double t[3] = {camera.t.x, camera.t.y, camera.t.z};
    for (int k = 0; k < 3; ++k) {
        const Vec3 r = camera.R.row[k];
        const double shift = t[k];
        EDGEGRAD_ROLLED
        for (int i = 0; i < lanes; ++i) l.q[k][i] = (r.x * l.p[0][i] + r.y * l.p[1][i] + r.z * l.p[2][i]) + shift;
    }
    // At the eye itself every plane is met and the projection is undefined: call it outside all.
    const double eye = camera.perspective ? 0 : -std::numeric_limits<double>::infinity();
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) l.outcode[i] = l.q[2][i] <= eye ? 16 : 0;
    for (int k = 0; k < 4; ++k) {
        const Vec3 n = volume.normal[k];
        const double offset = volume.offset[k], least = volume.least[k];
        const int32_t bit = 1 << k;
        EDGEGRAD_ROLLED
        for (int i = 0; i < lanes; ++i) {
            const double distance = (n.x * l.q[0][i] + n.y * l.q[1][i] + n.z * l.q[2][i]) + offset;
            l.outcode[i] |= distance < least ? bit : 0;
        }
    }
    const double *k = camera.k, flat = camera.perspective ? 0 : 1;
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const double w = 1.0 / (flat > 0 ? 1.0 : l.q[2][i]), x = l.q[0][i] * w, y = l.q[1][i] * w;
        l.x[0][i] = k[0] * x + k[1] * y + k[2], l.x[1][i] = k[3] * x + k[4] * y + k[5];
    }
}

}  // namespace

VertexView view_vertices(const Camera& camera, const ViewVolume& volume, const double* verts, int64_t n,
                         ThreadTeam& team) {
    VertexView view{Array<Vec3>(n), Array<Vec2>(n), Array<uint8_t>(n)};
    team.parallel_for_blocks(n, [&](int64_t, int64_t first, int64_t last) {
        VertexLanes l;
        Vec3* q = view.q.data();
        Vec2* x = view.x.data();
        uint8_t* outcode = view.outcode.data();
        for (int64_t g = first; g < last; g += VertexLanes::size) {
            const int count = int(std::min<int64_t>(VertexLanes::size, last - g));
            for (int i = 0; i < count; ++i)
                for (int k = 0; k < 3; ++k) l.p[k][i] = verts[3 * (g + i) + k];
            view_lanes(l, camera, volume);
            for (int i = 0; i < count; ++i) {
                q[g + i] = {l.q[0][i], l.q[1][i], l.q[2][i]};
                x[g + i] = {l.x[0][i], l.x[1][i]};
                outcode[g + i] = uint8_t(l.outcode[i]);
            }
        }
    });
    return view;
}

}  // namespace edgegrad
