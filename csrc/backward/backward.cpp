// This file combines the terms of the backward pass into the gradients of the user's arrays.

#include <algorithm>
#include <functional>
#include <numeric>
#include <optional>
#include <type_traits>
#include <vector>

#include "boundary/curve.h"
#include "camera/sub_cameras.h"
#include "discontinuities/discontinuities.h"
#include "estimator/budget.h"
#include "estimator/vertex_image.h"
#include "interior/interior.h"
#include "interior/surface_measure.h"
#include "primary/curve_measure.h"
#include "primary/primary_curves.h"
#include "secondary/indirect_shadows.h"
#include "secondary/secondary_edges.h"
#include "secondary/shadows.h"
#include "secondary/surface_edges.h"

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

// Terms tells which terms are wanted.
struct Terms {
    bool motion;      // interior term of motion
    bool appearance;  // interior term of colours and textures
    bool boundary;
    bool lens_boundary;    // lens boundary, in addition to other curves
    bool discontinuities;  // discontinuities within faces

    bool interior() const { return motion || appearance; }
    bool any() const { return interior() || boundary || discontinuities; }
};

template <class Number>
Terms terms_of(const Slots<Number>& slots, const GradientOptions& o) {
    const bool moves = slots.geometry();
    return {.motion = moves && o.interior_geometry,
            .appearance = slots.appearance(),
            .boundary = moves && o.boundary,
            .lens_boundary = (slots.K || slots.distortion) && o.boundary && o.intrinsics,
            .discontinuities = slots.discontinuities() && o.discontinuities};
}

// Returns the terms of everything that may move.
Terms all_motion(const GradientOptions& o) {
    return {.motion = o.interior_geometry,
            .appearance = false,
            .boundary = o.boundary,
            .lens_boundary = o.boundary && o.intrinsics,
            .discontinuities = o.discontinuities};
}

// InImage holds what all sub-cameras share of the image and its adjoint.
template <class T>
struct InImage {
    FilteredAdjoint<T> filtered;
    Importance importance;
    OcclusionHint occlusion;

    InImage(const BackwardInput<T>& input, ThreadTeam& team)
        : filtered(input.adjoint, input.scene, input.image.filter, input.camera.width, input.camera.height),
          importance(input.importance_map ? input.importance_map : input.adjoint, input.camera.width,
                     input.camera.height, input.importance_map ? 1 : input.scene.channels, margin_of(input.image), team,
                     !input.importance_map),
          occlusion(input.transparent ? nullptr : input.hits.depth, input.camera.width, input.camera.height, team) {}

    // Returns how far the pixel filter reaches beyond the image, px.
    static double margin_of(const ImageOptions& image) { return image.filter.radius() - 0.5; }
};

template <class T>
using ViewBody = std::function<void(const BackwardView<T>&)>;

// Calls body(view) with what all terms share for one sub-camera.
template <class T>
void with_view(const BackwardInput<T>& input, const Camera& camera, const InImage<T>& in_image,
               const GradientOptions& o, const Terms& terms, ThreadTeam& team, const ViewBody<T>& body) {
    const auto& [scene, whole, geometry, image, adjoint, hit_buffers, detailed, transparent, importance_map] = input;
    const auto& [filtered, importance, occlusion] = in_image;
    const ViewVolume volume(camera, InImage<T>::margin_of(image));
    const VertexView vertices = view_vertices(camera, volume, scene.verts, scene.n_verts, team);
    std::optional<AlphaMasks<T>> alpha_masks;
    if (scene.alpha_masks.face) alpha_masks.emplace(scene, camera, vertices.q.data());
    const AlphaTest* through = alpha_masks ? &*alpha_masks : nullptr;
    const CameraFrame frame(geometry.caster(), camera, through);
    Scatter scatter(team, {scene.radiance, scene.attributes.vertex_width, scene.attributes.face_width});
    // Controls of faces and creases need these hits.
    const bool creases = terms.boundary && may_jump(scene, geometry.topology());
    std::optional<ImageHits> hits;
    if (!o.pixel_spp && (terms.interior() || creases))
        hits.emplace(scene, camera, vertices, occlusion, geometry.parts(), hit_buffers.seen, team);
    const bool controls = hits && terms.interior() && o.controls && camera.is_undistorted();
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
                         .alpha_masks = through,
                         .transparent = transparent,
                         .occlusion = occlusion,
                         .hits = hits ? &*hits : nullptr,
                         .detailed = detailed,
                         .seen = hit_buffers.seen,
                         .hit = hit_buffers.hit,
                         .vertex_adjoint = vertex_adjoint,
                         .curve_offset = curve_offset_of(camera, frame, vertices, team)});
}

// Measured holds where the terms sample, and how often.
template <class T>
struct Measured {
    std::optional<SurfaceMeasure<T>> surface;
    std::optional<Curves<T>> curves;
    SampleCounts wanted;
};

template <class T>
Measured<T> measure_terms(const BackwardView<T>& view, const Terms& terms, GradientSink& to, BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    Stopwatch watch;
    Measured<T> out;
    Array<int8_t> facing(terms.boundary ? view.scene.n_faces : 0);
    if (terms.interior()) {
        out.surface.emplace(measure_surface(view, terms.motion, facing, to));
        out.wanted.surface = out.surface->wanted(o.surface_samples);
        profile.surface_wanted = out.surface->pixel_samples() + out.wanted.surface;
        profile.measure = watch.lap();
    }
    if (terms.boundary) {
        if (!terms.interior()) facing = facing_of_faces(view);
        const Curves<T>& curves = out.curves.emplace(measure_curves(view, std::move(facing), terms.lens_boundary));
        out.wanted.edge = profile.edge_wanted = curves.wanted(o);
        profile.silhouettes = curves.silhouettes, profile.creases = curves.creases;
        profile.intersections = curves.intersections, profile.lens_boundary = curves.lens_boundary;
        profile.curves = watch.lap();
    }
    return out;
}

// Limits the samples to the budget of the image, except numbers that the user sets.
template <class T>
SampleCounts within_budget(const BackwardInput<T>& input, const GradientOptions& o, SampleCounts wanted,
                           ThreadTeam& team) {
    const int64_t pixels = int64_t(input.camera.width) * input.camera.height;
    const SampleBudget budget(input.hits.coverage, pixels, input.image.spp, o.lit, team);
    SampleCounts n = budget.share(wanted);
    if (o.surface_samples >= 0) n.surface = wanted.surface;
    if (o.edge_samples >= 0) n.edge = wanted.edge;
    return n;
}

// Measures what the terms sample, draws the samples and accumulates them.
template <class T>
void add_terms(const BackwardInput<T>& input, const BackwardView<T>& view, const Terms& terms,
               const Accumulation& accumulation, GradientSink& to, BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    if (o.pixel_spp) {
        std::vector<int64_t> all(int64_t(view.camera.width) * view.camera.height);
        std::iota(all.begin(), all.end(), 0);
        add_pixel_samples(view, {all, o.pixel_spp, o.seed, nullptr}, accumulation, to, profile.surface);
        return;
    }
    // Both terms are measured before samples are drawn, since they share a budget.
    Measured<T> measured = measure_terms(view, terms, to, profile);
    const SampleCounts n = within_budget(input, o, measured.wanted, view.team);
    if (measured.surface) add_interior(view, *measured.surface, n.surface, accumulation, to, profile);
    if (Curves<T>* curves = measured.curves ? &*measured.curves : nullptr) {
        add_boundary(view, *curves, n.edge, accumulation, to, profile);
        if (!curves->x_bar.empty()) add_places(view, curves->x_bar, to);
    }
    if (terms.discontinuities) add_discontinuities(view, accumulation, to, profile);
}

// Returns the options of each sub-camera. The samples of one image are divided in proportion to what each wants. A
// sub-camera that wants any gets some, because it alone shows its part.
template <class T>
std::vector<GradientOptions> options_of_sub_cameras(const BackwardInput<T>& input,
                                                    const std::vector<Camera>& sub_cameras, const InImage<T>& in_image,
                                                    const GradientOptions& o, const Terms& terms, ThreadTeam& team) {
    std::vector<GradientOptions> options(sub_cameras.size(), o);
    for (size_t k = 1; k < sub_cameras.size(); ++k) options[k].seed = hash(o.seed, k, gradient_stream + 1);
    if (sub_cameras.size() == 1 || o.pixel_spp) return options;
    GradientOptions counted = o;
    counted.surface_samples = counted.edge_samples = -1;
    std::vector<SampleCounts> wanted(sub_cameras.size());
    SampleCounts all;
    for (size_t k = 0; k < sub_cameras.size(); ++k)
        with_view<T>(input, sub_cameras[k], in_image, counted, terms, team, [&](const BackwardView<T>& view) {
            GradientSink none;
            BackwardProfile profile;
            measure_terms(view, terms, none, profile);
            wanted[k] = {profile.surface_wanted, profile.edge_wanted};
            all.surface += wanted[k].surface, all.edge += wanted[k].edge;
        });
    SampleCounts n = within_budget(input, counted, all, team);
    if (o.surface_samples >= 0) n.surface = o.surface_samples;
    if (o.edge_samples >= 0) n.edge = o.edge_samples;
    const auto share = [](int64_t n, int64_t wanted, int64_t all) {
        return wanted ? std::max<int64_t>(1, std::llround(double(n) * (double(wanted) / double(all)))) : 0;
    };
    for (size_t k = 0; k < sub_cameras.size(); ++k) {
        options[k].surface_samples = share(n.surface, wanted[k].surface, all.surface);
        options[k].edge_samples = share(n.edge, wanted[k].edge, all.edge);
    }
    return options;
}

// Calls body(view) for each sub-camera of the camera.
template <class T>
void each_view(const BackwardInput<T>& input, const GradientOptions& o, const Terms& terms, ThreadTeam& team,
               const std::type_identity_t<ViewBody<T>>& body) {
    const std::vector<Camera> sub_cameras = sub_cameras_for_points(input.camera, InImage<T>::margin_of(input.image));
    const InImage<T> in_image(input, team);
    const std::vector<GradientOptions> options = options_of_sub_cameras(input, sub_cameras, in_image, o, terms, team);
    for (size_t k = 0; k < sub_cameras.size(); ++k)
        with_view(input, sub_cameras[k], in_image, options[k], terms, team, body);
}

// Calls body(view) for one sub-camera, where the result does not depend on which.
template <class T>
void with_any_sub_camera(const BackwardInput<T>& input, const GradientOptions& o, ThreadTeam& team,
                         const std::type_identity_t<ViewBody<T>>& body) {
    const Camera sub_camera = sub_cameras_for_points(input.camera, InImage<T>::margin_of(input.image)).front();
    with_view<T>(input, sub_camera, InImage<T>(input, team), o, Terms{}, team, body);
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
    discontinuity_lines += o.discontinuity_lines, shadow_samples += o.shadow_samples;
    for (int i = 0; i < 2; ++i)
        surface[i] += o.surface[i], edge[i] += o.edge[i], discontinuity[i] += o.discontinuity[i];
    return *this;
}

void add_world(const Camera& sub_camera, const double* verts, const Array<double>& q_bar, ThreadTeam& team,
               const Gradients& grad) {
    const auto parts = team.map_blocks(q_bar.size() / 3, [&](int64_t first, int64_t last) {
        std::array<double, 12> sum{};
        for (int64_t v = first; v < last; ++v) {
            const double *q = q_bar.data() + 3 * v, *p = verts + 3 * v;
            if (q[0] == 0 && q[1] == 0 && q[2] == 0) continue;
            if (grad.verts) {
                const Vec3 p_bar = transposed_times(sub_camera.R, {q[0], q[1], q[2]});
                grad.verts[3 * v] += p_bar.x, grad.verts[3 * v + 1] += p_bar.y, grad.verts[3 * v + 2] += p_bar.z;
            }
            if (grad.world_to_camera)
                for (int i = 0; i < 3; ++i) {
                    for (int j = 0; j < 3; ++j) sum[4 * i + j] += q[i] * p[j];
                    sum[4 * i + 3] += q[i];
                }
        }
        return sum;
    });
    if (grad.world_to_camera)
        for (const auto& sum : parts)
            for (int j = 0; j < 4; ++j) {
                const double* column = sum.data() + j;
                const Vec3 m = transposed_times(sub_camera.rotation, {column[0], column[4], column[8]});
                double* to = grad.world_to_camera + j;
                to[0] += m.x, to[4] += m.y, to[8] += m.z;
            }
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
std::vector<CurveRecords> record_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                         const GradientOptions& o, const LightParts& light, int64_t samples,
                                         ThreadTeam& team) {
    RecordList records;
    GradientSink to;
    to.records = &records;
    BackwardProfile profile;
    each_view(input, o, Terms{}, team, [&](const BackwardView<T>& view) {
        add_shadows(view, casters, light, samples, Record{o.intrinsics}, to, profile);
    });
    return std::move(records.curves);
}

template <class T>
std::vector<CurveRecords> record_secondary_edges(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                 const GradientOptions& o, const LitPaths& paths, int64_t samples,
                                                 ThreadTeam& team, SecondaryEdgeSamples& out) {
    RecordList records;
    GradientSink to;
    to.records = &records;
    const auto add = [&](const BackwardView<T>& view) {
        add_secondary_edges(view, casters, paths, samples, Record{o.intrinsics}, to, out);
    };
    if (paths.seen) each_view(input, o, Terms{}, team, add);
    else with_any_sub_camera<T>(input, o, team, add);
    return std::move(records.curves);
}

template <class T>
std::vector<CurveRecords> record_surface_edges(const BackwardInput<T>& input, const SceneView<T>& casters,
                                               const GradientOptions& o, const LitPaths& paths, MovingEdges moving,
                                               int64_t samples, ThreadTeam& team, SecondaryEdgeSamples& out) {
    RecordList records;
    GradientSink to;
    to.records = &records;
    with_any_sub_camera<T>(input, o, team, [&](const BackwardView<T>& view) {
        add_surface_edges(view, casters, paths, moving, samples, to, out);
    });
    return std::move(records.curves);
}

template <class T>
std::vector<CurveRecords> record_indirect_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                  const GradientOptions& o, const LightParts& light, int64_t samples,
                                                  ThreadTeam& team) {
    RecordList records;
    GradientSink to;
    to.records = &records;
    with_any_sub_camera<T>(
        input, o, team, [&](const BackwardView<T>& view) { add_indirect_shadows(view, casters, light, samples, to); });
    return std::move(records.curves);
}

#define EDGEGRAD_INSTANTIATE(T)                                                                                        \
    template BackwardProfile render_backward(const BackwardInput<T>&, const GradientOptions&, ThreadTeam&,             \
                                             const Gradients&);                                                        \
    template void render_tangents(const BackwardInput<T>&, GradientOptions, ThreadTeam&, const std::vector<Tangents>&, \
                                  double*);                                                                            \
    template void render_screen_gradient(const BackwardInput<T>&, GradientOptions, ThreadTeam&, double*);              \
    template RecordList record_samples(const BackwardInput<T>&, GradientOptions, ThreadTeam&);                         \
    template std::vector<CurveRecords> record_shadows(const BackwardInput<T>&, const SceneView<T>&,                    \
                                                      const GradientOptions&, const LightParts&, int64_t,              \
                                                      ThreadTeam&);                                                    \
    template std::vector<CurveRecords> record_secondary_edges(const BackwardInput<T>&, const SceneView<T>&,            \
                                                              const GradientOptions&, const LitPaths&, int64_t,        \
                                                              ThreadTeam&, SecondaryEdgeSamples&);                     \
    template std::vector<CurveRecords> record_surface_edges(const BackwardInput<T>&, const SceneView<T>&,              \
                                                            const GradientOptions&, const LitPaths&, MovingEdges,      \
                                                            int64_t, ThreadTeam&, SecondaryEdgeSamples&);              \
    template std::vector<CurveRecords> record_indirect_shadows(const BackwardInput<T>&, const SceneView<T>&,           \
                                                               const GradientOptions&, const LightParts&, int64_t,     \
                                                               ThreadTeam&);
EDGEGRAD_INSTANTIATE(float)
EDGEGRAD_INSTANTIATE(double)
#undef EDGEGRAD_INSTANTIATE

}  // namespace edgegrad
