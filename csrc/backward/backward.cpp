// The backward pass: the two terms, and what they found turned into the gradients of the user's arrays.

#include <algorithm>
#include <numeric>
#include <optional>
#include <vector>

#include "backward/budget.h"
#include "backward/vertex_image.h"
#include "boundary/boundary.h"
#include "boundary/curve.h"
#include "boundary/curve_measure.h"
#include "core/channels.h"
#include "interior/interior.h"
#include "interior/surface_measure.h"

namespace edgegrad {

namespace {

// δI = (1 − coverage) δbackground, pixel by pixel: exact for the image that the forward pass made.
template <class T>
void add_background(const SceneView<T>& scene, int64_t pixels, const T* adjoint, const T* coverage, Team& team,
                    double* grad) {
    const int C = scene.channels;
    if (scene.background_is_image) {
        team.each_block(pixels, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t p = first; p < last; ++p)
                for (int c = 0; c < C; ++c) grad[p * C + c] += (1 - double(coverage[p])) * adjoint[p * C + c];
        });
        return;
    }
    std::vector<double> sum(Team::blocks(pixels) * C, 0.0);
    team.each_block(pixels, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t p = first; p < last; ++p)
            for (int c = 0; c < C; ++c) sum[k * C + c] += (1 - double(coverage[p])) * adjoint[p * C + c];
    });
    for (int64_t k = 0; k < Team::blocks(pixels); ++k)
        for (int c = 0; c < C; ++c) grad[c] += sum[k * C + c];
}

// Which terms are asked for.
struct Terms {
    bool motion;      // inside faces, of what moves them
    bool appearance;  // inside faces, of colours and textures
    bool boundary;

    bool interior() const { return motion || appearance; }
    bool any() const { return interior() || boundary; }
};

template <class Number>
Terms terms_of(const Slots<Number>& slots, const GradientOptions& o) {
    const bool moves = slots.geometry();
    return {moves && o.interior_geometry, slots.appearance(), moves && o.boundary};
}

// Calls body(view) with what all terms look at.
template <class T, class Body>
void with_view(const BackwardInput<T>& input, const GradientOptions& o, const Terms& terms, Team& team, Body body) {
    const auto& [scene, camera, geometry, image, adjoint, hit_buffers] = input;
    const double margin = image.filter.radius() - 0.5;
    const ViewVolume volume(camera, margin);
    const VertexView vertices = view_vertices(camera, volume, scene.verts, scene.n_verts, team);
    const FilteredAdjoint<T> filtered(adjoint, scene, image.filter, camera.width, camera.height);
    const Importance importance(adjoint, camera.width, camera.height, scene.channels, margin, team);
    const OcclusionHint occlusion(hit_buffers.depth, camera.width, camera.height, team);
    const CameraFrame frame(geometry.caster(), camera);
    Scatter scatter(team, {scene.radiance, scene.attributes.vertex_width, scene.attributes.face_width});
    // What the controls need, of faces and of creases.
    const bool creases = terms.boundary && may_jump(scene, geometry.topology());
    std::optional<ImageHits> hits;
    if (!o.pixel_spp && (terms.interior() || creases))
        hits.emplace(scene, camera, vertices, occlusion, geometry.parts(), hit_buffers.seen, team);
    const bool controls = hits && terms.interior() && o.controls && camera.is_straight();
    const Array<T> vertex_adjoint =
        controls ? adjoint_at_vertices(filtered, vertices, *hits, scene.channels, team) : Array<T>(0);
    body(BackwardView<T>{.scene = scene,
                         .camera = camera,
                         .geometry = geometry,
                         .volume = volume,
                         .vertices = vertices,
                         .adjoint = filtered,
                         .importance = importance,
                         .image = image,
                         .options = o,
                         .team = team,
                         .scatter = scatter,
                         .frame = frame,
                         .occlusion = occlusion,
                         .hits = hits ? &*hits : nullptr,
                         .seen = hit_buffers.seen,
                         .hit = hit_buffers.hit,
                         .vertex_adjoint = vertex_adjoint});
}

// Measures what the terms sample, draws the samples and contracts them.
template <int N, class Contraction, class T>
void add_terms(const BackwardView<T>& view, const Terms& terms, const T* coverage, const Contraction& contraction,
               Destination& to, BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    const int64_t pixels = int64_t(view.camera.width) * view.camera.height;
    Stopwatch watch;
    if (o.pixel_spp) {
        std::vector<int64_t> all(pixels);
        std::iota(all.begin(), all.end(), 0);
        add_pixel_samples<N>(view, {all, o.pixel_spp, o.seed, nullptr}, contraction, to, profile.surface);
        return;
    }
    // Both terms are measured before samples are drawn, since they share a budget.
    SampleCounts wanted;
    std::optional<SurfaceMeasure<T>> surface;
    Array<int8_t> facing(terms.boundary ? view.scene.n_faces : 0);
    if (terms.interior()) {
        surface.emplace(measure_surface<N>(view, terms.motion, facing, to));
        wanted.surface = surface->wanted(o.surface_samples);
        profile.surface_wanted = surface->pixel_samples() + wanted.surface;
        profile.measure = watch.lap();
    }
    std::optional<Curves<T>> curves;
    if (terms.boundary) {
        if (!terms.interior()) facing = facing_of_faces(view);
        curves.emplace(measure_curves<N>(view, std::move(facing)));
        wanted.edge = profile.edge_wanted = curves->wanted(o.edge_samples);
        profile.silhouettes = curves->silhouettes, profile.creases = curves->creases;
        profile.intersections = curves->intersections;
        profile.curves = watch.lap();
    }
    const SampleBudget budget(coverage, pixels, view.image.spp, view.team);
    SampleCounts n = budget.share(wanted);
    if (o.surface_samples >= 0) n.surface = wanted.surface;
    if (o.edge_samples >= 0) n.edge = wanted.edge;
    if (surface) add_interior<N>(view, *surface, n.surface, contraction, to, profile);
    if (curves) {
        add_boundary<N>(view, *curves, n.edge, contraction, to, profile);
        if (!curves->x_bar.empty()) add_places(view, curves->x_bar, to);
    }
}

// δI = (1 − coverage) δbackground of direction d, for pixels (H, W, D, C).
template <class T>
void add_background_tangent(const BackwardInput<T>& input, Directions directions, Team& team, double* image_dot) {
    const int C = input.scene.channels;
    const int64_t pixels = int64_t(input.camera.width) * input.camera.height, D = int64_t(directions.size());
    team.each_block(pixels, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t p = first; p < last; ++p)
            for (int64_t d = 0; d < D; ++d)
                if (const double* dot = directions[d].tangents.background)
                    for (int c = 0; c < C; ++c)
                        image_dot[(p * D + d) * C + c] += (1 - double(input.hits.coverage[p])) *
                                                          dot[(input.scene.background_is_image ? p * C : 0) + c];
    });
}

}  // namespace

void add_world(const Camera& camera, const double* verts, const Array<double>& q_bar, Team& team,
               const Gradients& grad) {
    const int64_t V = q_bar.size() / 3, blocks = Team::blocks(V);
    std::vector<double> sum(grad.world_to_camera ? 12 * blocks : 0, 0.0);
    team.each_block(V, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) {
            const double *q = q_bar.data() + 3 * v, *p = verts + 3 * v;
            if (q[0] == 0 && q[1] == 0 && q[2] == 0) continue;
            if (grad.verts) {
                const Vec3 p_bar = transposed_times(camera.R, {q[0], q[1], q[2]});
                grad.verts[3 * v] += p_bar.x, grad.verts[3 * v + 1] += p_bar.y, grad.verts[3 * v + 2] += p_bar.z;
            }
            if (grad.world_to_camera)
                for (int i = 0; i < 3; ++i) {
                    for (int j = 0; j < 3; ++j) sum[12 * k + 4 * i + j] += q[i] * p[j];
                    sum[12 * k + 4 * i + 3] += q[i];
                }
        }
    });
    if (grad.world_to_camera)
        for (int64_t k = 0; k < blocks; ++k)
            for (int i = 0; i < 12; ++i) grad.world_to_camera[i] += sum[12 * k + i];
}

template <class T>
BackwardProfile render_backward(const BackwardInput<T>& input, const GradientOptions& o, Team& team,
                                const Gradients& grad) {
    const auto& [scene, camera, geometry, image, adjoint, hits] = input;
    BackwardProfile profile;
    Stopwatch watch;
    if (grad.background)
        add_background(scene, int64_t(camera.width) * camera.height, adjoint, hits.coverage, team, grad.background);
    const Terms terms = terms_of(grad, o);
    if (!terms.any()) return profile;
    Array<double> q_bar{0};
    Destination to;
    with_view(input, o, terms, team, [&](const BackwardView<T>& view) {
        profile.view = watch.lap();
        q_bar = zeros(grad.geometry() ? 3 * scene.n_verts : 0, team);
        to.want_k = grad.K || grad.distortion;
        to.q = grad.geometry() ? q_bar.data() : nullptr;
        to.colors = grad.colors, to.uvs = grad.uvs, to.texels = grad.texels;
        to.vertex_attributes = grad.vertex_attributes, to.face_attributes = grad.face_attributes;
        dispatch_channels(scene.channels, scene.channels > scene.radiance, [&]<int N>() {
            add_terms<N>(view, terms, hits.coverage, Reverse{terms.motion}, to, profile);
        });
    });
    watch.lap();
    if (grad.geometry()) add_world(camera, scene.verts, q_bar, team, grad);
    if (grad.K)
        for (int i = 0; i < 6; ++i) grad.K[i] += to.k.k[i];
    if (grad.distortion)
        for (int i = 0; i < most_coefficients; ++i) grad.distortion[i] += to.k.distortion[i];
    profile.world = watch.lap();
    return profile;
}

template <class T>
void render_tangents(const BackwardInput<T>& input, GradientOptions o, Team& team,
                     const std::vector<Tangents>& tangents, double* image_dot) {
    const auto& [scene, camera, geometry, image, adjoint, hits] = input;
    std::vector<Direction> directions;
    Terms terms{};
    for (const Tangents& t : tangents) {
        directions.push_back(make_direction(t, camera, scene.verts, scene.n_verts, team));
        const Terms own = terms_of(t, o);
        terms = {terms.motion || own.motion, terms.appearance || own.appearance, terms.boundary || own.boundary};
    }
    add_background_tangent(input, directions, team, image_dot);
    if (!terms.any()) return;
    o.controls = false;
    Destination to;
    to.pixels = image_dot, to.pixel_width = int(directions.size()) * scene.channels;
    BackwardProfile profile;
    with_view(input, o, terms, team, [&](const BackwardView<T>& view) {
        add_terms<0>(view, terms, hits.coverage, Forward{directions}, to, profile);
    });
}

template <class T>
void render_screen_gradient(const BackwardInput<T>& input, GradientOptions o, Team& team, double* gradient) {
    const Terms terms{.motion = o.interior_geometry, .appearance = false, .boundary = o.boundary};
    if (!terms.any()) return;
    o.controls = false;
    Destination to;
    to.pixels = gradient, to.pixel_width = 2;
    BackwardProfile profile;
    with_view(input, o, terms, team, [&](const BackwardView<T>& view) {
        add_terms<0>(view, terms, input.hits.coverage, Screen{}, to, profile);
    });
}

template <class T>
Records record_samples(const BackwardInput<T>& input, GradientOptions o, Team& team) {
    Records records;
    const Terms terms{.motion = o.interior_geometry, .appearance = false, .boundary = o.boundary};
    if (!terms.any()) return records;
    o.controls = false;
    Destination to;
    to.records = &records;
    BackwardProfile profile;
    with_view(input, o, terms, team, [&](const BackwardView<T>& view) {
        add_terms<0>(view, terms, input.hits.coverage, Record{}, to, profile);
    });
    return records;
}

#define EDGEGRAD_INSTANTIATE(T)                                                                                  \
    template BackwardProfile render_backward(const BackwardInput<T>&, const GradientOptions&, Team&,             \
                                             const Gradients&);                                                  \
    template void render_tangents(const BackwardInput<T>&, GradientOptions, Team&, const std::vector<Tangents>&, \
                                  double*);                                                                      \
    template void render_screen_gradient(const BackwardInput<T>&, GradientOptions, Team&, double*);              \
    template Records record_samples(const BackwardInput<T>&, GradientOptions, Team&);
EDGEGRAD_INSTANTIATE(float)
EDGEGRAD_INSTANTIATE(double)
#undef EDGEGRAD_INSTANTIATE

}  // namespace edgegrad
