// Vertices in the image: the filtered adjoint at their places, and the cotangents of these places. Controls (control.h,
// crease_control.h) are made of both.
#pragma once

#include <cstdint>
#include <vector>

#include "core/channels.h"
#include "estimator/view.h"

namespace edgegrad {

// Ã at the vertices of faces that the image hit, (V, C); elsewhere, and outside the view, not set.
template <class T>
Array<T> adjoint_at_vertices(const FilteredAdjoint<T>& filtered, const VertexView& vertices, const ImageHits& hits,
                             int C, ThreadTeam& team) {
    const int64_t V = vertices.q.size();
    Array<T> adjoint(V * C);
    dispatch_channels(C, false, [&]<int N>() {
        team.parallel_for_blocks(V, [&](int64_t, int64_t first, int64_t last) {
            std::vector<double> A(C);
            for (int64_t v = first; v < last; ++v) {
                if (!hits.at(v) || vertices.outcode[v]) continue;
                filtered.template at<N>(vertices.x[v], A.data());
                for (int c = 0; c < C; ++c) adjoint[v * C + c] = T(A[c]);
            }
        });
    });
    return adjoint;
}

// Adds cotangents of places in the image (V, 2) to those of camera coordinates and of K.
template <class T>
void add_places(const BackwardView<T>& view, const Array<double>& x_bar, GradientSink& to) {
    const auto intrinsics = view.team.map_blocks(view.scene.n_verts, [&](int64_t first, int64_t last) {
        IntrinsicsGrad sum;
        for (int64_t v = first; v < last; ++v) {
            const Vec2 x{x_bar[2 * v], x_bar[2 * v + 1]};
            if (x.x == 0 && x.y == 0) continue;
            Vec3 q;
            project_vjp(view.camera, view.vertices.q[v], x, q, sum);
            to.q[3 * v] += q.x, to.q[3 * v + 1] += q.y, to.q[3 * v + 2] += q.z;
        }
        return sum;
    });
    for (const IntrinsicsGrad& g : intrinsics) to.k += g;
}

}  // namespace edgegrad
