// This file combines the terms of the backward pass into the gradients of the user's arrays.

#include "backward/backward.h"

#include "accumulate/world.h"
#include "backward/sub_camera_views.h"
#include "backward/terms.h"
#include "camera/sub_cameras.h"

namespace edgegrad {

namespace {

// Adds δI = (1 − coverage) δbackground, pixel by pixel. It is exact for the image of the forward pass.
template <class T>
void add_background(const SceneView<T>& scene, int64_t pixels, const T* adjoint, const T* coverage, ThreadTeam& team,
                    double* grad) {
    const int C = scene.channels;
    if (scene.background_is_image) {
        team.parallel_for_blocks(pixels, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t p = first; p < last; ++p)
                for (int c = 0; c < C; ++c) grad[p * C + c] += (1 - double(coverage[p])) * adjoint[p * C + c];
        });
        return;
    }
    const auto parts = team.map_blocks(pixels, [&](int64_t first, int64_t last) {
        std::vector<double> sum(C, 0.0);
        for (int64_t p = first; p < last; ++p)
            for (int c = 0; c < C; ++c) sum[c] += (1 - double(coverage[p])) * adjoint[p * C + c];
        return sum;
    });
    for (const std::vector<double>& sum : parts)
        for (int c = 0; c < C; ++c) grad[c] += sum[c];
}

// Adds δI = (1 − coverage) δbackground of direction d, for pixels (H, W, D, C).
template <class T>
void add_background_tangent(const BackwardInput<T>& input, const std::vector<Tangents>& directions, ThreadTeam& team,
                            double* image_dot) {
    const int C = input.scene.channels;
    const int64_t pixels = int64_t(input.camera.width) * input.camera.height, D = int64_t(directions.size());
    team.parallel_for_blocks(pixels, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t p = first; p < last; ++p)
            for (int64_t d = 0; d < D; ++d)
                if (const double* dot = directions[d].background)
                    for (int c = 0; c < C; ++c)
                        image_dot[(p * D + d) * C + c] += (1 - double(input.hits.coverage[p])) *
                                                          dot[(input.scene.background_is_image ? p * C : 0) + c];
    });
}

}  // namespace

BackwardProfile& BackwardProfile::operator+=(const BackwardProfile& o) {
    surface_samples += o.surface_samples, edge_samples += o.edge_samples;
    surface_wanted += o.surface_wanted, edge_wanted += o.edge_wanted;
    silhouettes += o.silhouettes, creases += o.creases, intersections += o.intersections,
        lens_boundary += o.lens_boundary;
    measure += o.measure, curves += o.curves, view += o.view, world += o.world;
    discontinuity_lines += o.discontinuity_lines;
    for (int i = 0; i < 2; ++i)
        surface[i] += o.surface[i], edge[i] += o.edge[i], discontinuity[i] += o.discontinuity[i];
    return *this;
}

template <class T>
BackwardProfile render_backward(const BackwardInput<T>& input, const GradientOptions& o, ThreadTeam& team,
                                const Gradients& grad) {
    const auto& [scene, camera, geometry, image, adjoint, hits, detailed, transparent, importance_map] = input;
    BackwardProfile profile;
    Stopwatch watch;
    if (grad.background)
        add_background(scene, int64_t(camera.width) * camera.height, adjoint, hits.coverage, team, grad.background);
    const Terms terms = terms_of(grad, o);
    if (!terms.any()) return profile;
    each_view(input, o, terms, team, [&](const BackwardView<T>& view) {
        BackwardProfile own{.view = watch.lap()};
        Array<double> q_bar = zeros(grad.geometry() ? 3 * scene.n_verts : 0, team);
        GradientSink to;
        to.want_k = grad.K || grad.distortion;
        to.q = grad.geometry() ? q_bar.data() : nullptr;
        to.colors = grad.colors, to.uvs = grad.uvs, to.texels = grad.texels, to.alphas = grad.alphas;
        to.vertex_attributes = grad.vertex_attributes, to.face_attributes = grad.face_attributes;
        add_terms(input, view, terms, Reverse{terms.motion}, to, own);
        watch.lap();
        if (grad.geometry()) add_world(view.camera, scene.verts, q_bar, team, grad);
        add_intrinsics(view.camera, to.k, grad.K, grad.distortion);
        own.world = watch.lap();
        profile += own;
    });
    return profile;
}

template <class T>
void render_tangents(const BackwardInput<T>& input, GradientOptions o, ThreadTeam& team,
                     const std::vector<Tangents>& tangents, double* image_dot) {
    const SceneView<T>& scene = input.scene;
    Terms terms{};
    for (const Tangents& t : tangents) {
        const Terms own = terms_of(t, o);
        terms.motion |= own.motion, terms.appearance |= own.appearance;
        terms.boundary |= own.boundary, terms.lens_boundary |= own.lens_boundary,
            terms.discontinuities |= own.discontinuities;
    }
    add_background_tangent(input, tangents, team, image_dot);
    if (!terms.any()) return;
    o.controls = false;
    GradientSink to;
    to.pixels = image_dot, to.pixel_width = int(tangents.size()) * scene.channels;
    BackwardProfile profile;
    each_view(input, o, terms, team, [&](const BackwardView<T>& view) {
        std::vector<Direction> directions;
        for (const Tangents& t : tangents)
            directions.push_back(make_direction(t, view.camera, scene.verts, scene.n_verts, team));
        add_terms(input, view, terms, Forward{directions}, to, profile);
    });
}

template <class T>
void render_screen_gradient(const BackwardInput<T>& input, GradientOptions o, ThreadTeam& team, double* gradient) {
    const Terms terms = all_motion(o);
    if (!terms.any()) return;
    o.controls = false;
    GradientSink to;
    to.pixels = gradient, to.pixel_width = 2;
    BackwardProfile profile;
    each_view(input, o, terms, team,
              [&](const BackwardView<T>& view) { add_terms(input, view, terms, Screen{}, to, profile); });
}

template <class T>
RecordList record_samples(const BackwardInput<T>& input, GradientOptions o, ThreadTeam& team) {
    RecordList records;
    const Terms terms = all_motion(o);
    if (!terms.any()) return records;
    o.controls = false;
    GradientSink to;
    to.records = &records;
    BackwardProfile profile;
    each_view(input, o, terms, team,
              [&](const BackwardView<T>& view) { add_terms(input, view, terms, Record{o.intrinsics}, to, profile); });
    return records;
}

template <class T>
std::vector<CurveRecords> record_curves(const BackwardInput<T>& input, const GradientOptions& o, bool seen,
                                        ThreadTeam& team, const std::type_identity_t<RecordBody<T>>& record) {
    RecordList records;
    GradientSink to;
    to.records = &records;
    const auto body = [&](const BackwardView<T>& view) { record(view, to); };
    if (seen) each_view(input, o, Terms{}, team, body);
    else with_any_sub_camera(input, o, team, body);
    return std::move(records.curves);
}

#define EDGEGRAD_INSTANTIATE(T)                                                                                        \
    template BackwardProfile render_backward(const BackwardInput<T>&, const GradientOptions&, ThreadTeam&,             \
                                             const Gradients&);                                                        \
    template void render_tangents(const BackwardInput<T>&, GradientOptions, ThreadTeam&, const std::vector<Tangents>&, \
                                  double*);                                                                            \
    template void render_screen_gradient(const BackwardInput<T>&, GradientOptions, ThreadTeam&, double*);              \
    template RecordList record_samples(const BackwardInput<T>&, GradientOptions, ThreadTeam&);                         \
    template std::vector<CurveRecords> record_curves(const BackwardInput<T>&, const GradientOptions&, bool,            \
                                                     ThreadTeam&, const RecordBody<T>&);
EDGEGRAD_INSTANTIATE(float)
EDGEGRAD_INSTANTIATE(double)
#undef EDGEGRAD_INSTANTIATE

}  // namespace edgegrad
