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
    const auto& [scene, camera, geometry, image, adjoint, hit_buffers] = input;
    const int64_t pixels = int64_t(camera.width) * camera.height;
    BackwardProfile profile;
    Stopwatch watch;
    if (grad.background) add_background(scene, pixels, adjoint, hit_buffers.coverage, team, grad.background);

    const bool interior_geometry = grad.geometry() && o.interior_geometry, boundary = grad.geometry() && o.boundary;
    if (!interior_geometry && !boundary && !grad.appearance()) return profile;

    const ViewVolume volume(camera, image.filter.radius() - 0.5);
    const VertexView vertices = view_vertices(camera, volume, scene.verts, scene.n_verts, team);
    const FilteredAdjoint<T> filtered(adjoint, scene, image.filter, camera.width, camera.height);
    const Importance importance(adjoint, camera.width, camera.height, scene.channels, image.filter.radius() - 0.5,
                                team);
    const OcclusionHint occlusion(hit_buffers.depth, camera.width, camera.height, team);
    const RayFrame frame(geometry.caster(), camera);
    Scatter scatter(team, scene.channels);
    // What the controls need, of faces and of creases.
    const bool interior = interior_geometry || grad.appearance();
    const bool creases = boundary && may_jump(scene, geometry.topology());
    std::optional<ImageHits> hits;
    if (!o.pixel_spp && (interior || creases))
        hits.emplace(scene, vertices, occlusion, geometry.parts(), hit_buffers.seen, team);
    const Array<T> vertex_adjoint =
        hits && interior ? adjoint_at_vertices(filtered, vertices, *hits, scene.channels, team) : Array<T>(0);
    const BackwardView<T> view{.scene = scene,
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
                               .vertex_adjoint = vertex_adjoint};
    profile.view = watch.lap();

    Array<double> q_bar = zeros(grad.geometry() ? 3 * scene.n_verts : 0, team);
    Destination to;
    to.want_k = grad.K;
    to.q = grad.geometry() ? q_bar.data() : nullptr;
    to.colors = grad.colors, to.uvs = grad.uvs, to.texels = grad.texels;
    dispatch_channels(scene.channels, [&]<int N>() {
        if (o.pixel_spp) {
            std::vector<int64_t> all(pixels);
            std::iota(all.begin(), all.end(), 0);
            add_pixel_samples<N>(view, all, o.pixel_spp, o.seed, nullptr, interior_geometry, to, profile.surface);
            return;
        }
        // Both terms are measured before samples are drawn, since they share a budget.
        SampleCounts wanted;
        std::optional<SurfaceMeasure<T>> surface;
        Array<int8_t> facing(boundary ? scene.n_faces : 0);
        if (interior) {
            watch.lap();
            surface.emplace(measure_surface<N>(view, interior_geometry, facing, to));
            wanted.surface = surface->wanted(o.surface_samples);
            profile.surface_wanted = surface->pixel_samples() + wanted.surface;
            profile.measure = watch.lap();
        }
        std::optional<Curves<T>> curves;
        if (boundary) {
            watch.lap();
            if (!interior) facing = facing_of_faces(view);
            curves.emplace(measure_curves<N>(view, std::move(facing)));
            wanted.edge = profile.edge_wanted = curves->wanted(o.edge_samples);
            profile.silhouettes = curves->silhouettes, profile.creases = curves->creases;
            profile.curves = watch.lap();
        }
        const SampleBudget budget(hit_buffers.coverage, pixels, image.spp, team);
        SampleCounts n = budget.share(wanted);
        if (o.surface_samples >= 0) n.surface = wanted.surface;
        if (o.edge_samples >= 0) n.edge = wanted.edge;
        if (surface) add_interior<N>(view, *surface, n.surface, interior_geometry, to, profile);
        if (curves) {
            add_boundary<N>(view, *curves, n.edge, to, profile);
            if (!curves->x_bar.empty()) add_places(view, curves->x_bar, to);
        }
    });
    watch.lap();
    if (grad.geometry()) add_world(camera, scene.verts, q_bar, team, grad);
    if (grad.K)
        for (int i = 0; i < 6; ++i) grad.K[i] += to.k[i];
    profile.world = watch.lap();
    return profile;
}

template BackwardProfile render_backward(const BackwardInput<float>&, const GradientOptions&, Team&, const Gradients&);
template BackwardProfile render_backward(const BackwardInput<double>&, const GradientOptions&, Team&, const Gradients&);

}  // namespace edgegrad
