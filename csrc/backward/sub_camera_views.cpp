#include "backward/sub_camera_views.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "boundary/curve.h"
#include "camera/sub_cameras.h"
#include "estimator/vertex_image.h"

namespace edgegrad {

namespace {

// WholeImage holds what all sub-cameras share of the image and its adjoint.
template <class T>
struct WholeImage {
    FilteredAdjoint<T> filtered;
    Importance importance;
    OcclusionHint occlusion;

    WholeImage(const BackwardInput<T>& input, ThreadTeam& team)
        : filtered(input.adjoint, input.scene, input.image.filter, input.camera.width, input.camera.height),
          importance(input.importance_map ? input.importance_map : input.adjoint, input.camera.width,
                     input.camera.height, input.importance_map ? 1 : input.scene.channels, margin_of(input.image), team,
                     !input.importance_map),
          occlusion(input.transparent ? nullptr : input.hits.depth, input.camera.width, input.camera.height, team) {}

    // Returns how far the pixel filter reaches beyond the image, px.
    static double margin_of(const ImageOptions& image) { return image.filter.radius() - 0.5; }
};

// Calls body(view) with what all terms share for one sub-camera.
template <class T>
void with_view(const BackwardInput<T>& input, const Camera& camera, const WholeImage<T>& whole_image,
               const GradientOptions& o, const Terms& terms, ThreadTeam& team, const ViewBody<T>& body) {
    const auto& [scene, whole, geometry, image, adjoint, hit_buffers, detailed, transparent, importance_map] = input;
    const auto& [filtered, importance, occlusion] = whole_image;
    const ViewVolume volume(camera, WholeImage<T>::margin_of(image));
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

// Returns the options of each sub-camera. The samples of one image are divided in proportion to what each wants. A
// sub-camera that wants any gets some, because it alone shows its part.
template <class T>
std::vector<GradientOptions> options_of_sub_cameras(const BackwardInput<T>& input,
                                                    const std::vector<Camera>& sub_cameras,
                                                    const WholeImage<T>& whole_image, const GradientOptions& o,
                                                    const Terms& terms, ThreadTeam& team) {
    std::vector<GradientOptions> options(sub_cameras.size(), o);
    for (size_t k = 1; k < sub_cameras.size(); ++k) options[k].seed = hash(o.seed, k, gradient_stream + 1);
    if (sub_cameras.size() == 1 || o.pixel_spp) return options;
    GradientOptions counted = o;
    counted.surface_samples = counted.edge_samples = -1;
    std::vector<SampleCounts> wanted(sub_cameras.size());
    SampleCounts all;
    for (size_t k = 0; k < sub_cameras.size(); ++k)
        with_view<T>(input, sub_cameras[k], whole_image, counted, terms, team, [&](const BackwardView<T>& view) {
            wanted[k] = wanted_samples(view, terms);
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

}  // namespace

template <class T>
void each_view(const BackwardInput<T>& input, const GradientOptions& o, const Terms& terms, ThreadTeam& team,
               const std::type_identity_t<ViewBody<T>>& body) {
    const std::vector<Camera> sub_cameras = sub_cameras_for_points(input.camera, WholeImage<T>::margin_of(input.image));
    const WholeImage<T> whole_image(input, team);
    const std::vector<GradientOptions> options =
        options_of_sub_cameras(input, sub_cameras, whole_image, o, terms, team);
    for (size_t k = 0; k < sub_cameras.size(); ++k)
        with_view(input, sub_cameras[k], whole_image, options[k], terms, team, body);
}

template <class T>
void with_any_sub_camera(const BackwardInput<T>& input, const GradientOptions& o, ThreadTeam& team,
                         const std::type_identity_t<ViewBody<T>>& body) {
    const Camera sub_camera = sub_cameras_for_points(input.camera, WholeImage<T>::margin_of(input.image)).front();
    with_view<T>(input, sub_camera, WholeImage<T>(input, team), o, Terms{}, team, body);
}

#define EDGEGRAD_INSTANTIATE(T)                                                                         \
    template void each_view(const BackwardInput<T>&, const GradientOptions&, const Terms&, ThreadTeam&, \
                            const ViewBody<T>&);                                                        \
    template void with_any_sub_camera(const BackwardInput<T>&, const GradientOptions&, ThreadTeam&, const ViewBody<T>&);
EDGEGRAD_INSTANTIATE(float)
EDGEGRAD_INSTANTIATE(double)
#undef EDGEGRAD_INSTANTIATE

}  // namespace edgegrad
