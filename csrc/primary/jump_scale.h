// What the sizes of jumps in all channels are compared by.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "estimator/view.h"

namespace edgegrad {

struct JumpScale {
    std::vector<double> weights;  // of the channels
    double unknown = 0;           // the size of a jump of which nothing is known: Σ_c weight_c · (mean |L_c|)
};

// Mean of Σ_c weight_c |value_c| over all rows.
template <class Number>
double mean_size(const Number* values, int64_t rows, const double* weights, int width, ThreadTeam& team) {
    if (rows == 0 || width == 0) return 0;
    const std::vector<double> parts = team.map_blocks(rows, [&](int64_t first, int64_t last) {
        double sum = 0;
        for (int64_t i = first; i < last; ++i)
            for (int c = 0; c < width; ++c) sum += weights[c] * std::fabs(values[i * width + c]);
        return sum;
    });
    double all = 0;
    for (const double part : parts) all += part;
    return all / double(rows);
}

// The channels of radiance have one unit. Attributes have units of their own, so there a channel counts as much as the
// loss depends on it.
template <class T>
JumpScale jump_scale(const BackwardView<T>& view) {
    const SceneView<T>& scene = view.scene;
    const int C = scene.channels, R = scene.radiance;
    JumpScale out{std::vector<double>(C, 1.0)};
    if (C > R) {
        const int64_t pixels = int64_t(view.camera.width) * view.camera.height;
        const auto parts = view.team.map_blocks(pixels, [&](int64_t first, int64_t last) {
            std::vector<double> sum(C, 0.0);
            for (int64_t p = first; p < last; ++p)
                for (int c = 0; c < C; ++c) sum[c] += std::fabs(view.adjoint.of(p)[c]);
            return sum;
        });
        std::fill(out.weights.begin(), out.weights.end(), 0.0);
        for (const std::vector<double>& sum : parts)
            for (int c = 0; c < C; ++c) out.weights[c] += sum[c] / double(pixels);
    }
    const double* weights = out.weights.data();
    out.unknown = mean_size(scene.colors, scene.n_colors, weights, R, view.team);
    if (C > R) {
        const Attributes& a = scene.attributes;
        weights += R;
        if (a.alpha) out.unknown += *weights++;
        out.unknown += mean_size(a.vertex, scene.n_verts, weights, a.vertex_width, view.team);
        weights += a.vertex_width;
        out.unknown += mean_size(a.face, scene.n_faces, weights, a.face_width, view.team);
        weights += a.face_width;
        for (int i = 0; i < 3 * a.barycentrics; ++i) out.unknown += *weights++ / 3;
        if (a.uv) out.unknown += mean_size(scene.uvs, scene.n_uvs, weights, 2, view.team);
    }
    return out;
}

}  // namespace edgegrad
