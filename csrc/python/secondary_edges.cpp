// Binds samples on secondary edges, the edges seen from the surface points of light paths, for images made in PyTorch.

#include "secondary/secondary_edges.h"

#include <nanobind/stl/optional.h>

#include <optional>
#include <vector>

#include "backward/backward.h"
#include "python/arrays.h"
#include "python/curve_arrays.h"
#include "python/lit_arrays.h"
#include "python/shaped.h"
#include "python/unlocked.h"
#include "secondary/estimator.h"
#include "secondary/surface_edges.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

nb::object joined_rows(const std::vector<std::vector<double>>& parts, size_t width) {
    std::vector<double> out;
    for (const std::vector<double>& part : parts) out.insert(out.end(), part.begin(), part.end());
    return rows(std::move(out), {width});
}

// Holds the input of both kinds of samples. `casters` are the same faces as light sees them.
template <class T>
struct EdgeSampleInput {
    const SceneArrays<T>&arrays, &casters;
    const LitArrays& lit;
    const Camera& camera;
    const ImageOptions& image;
    const HitArrays<T>& hits;
    const std::optional<In<uint8_t, 1>>& transparent;
    double least;
    int threads;

    // Returns the records that add(view, casters, sink, samples) adds, with their first point alone. `seen` tells
    // whether the camera must see that point. If not, SecondaryEdgeSamples has the jumps (S, channels) and origins (S,
    // 3).
    template <class Add>
    nb::tuple samples(const LitPaths& paths, const GradientOptions& options, GeometryWanted wanted, Add add) const {
        hits.check(arrays, camera), check_faces(arrays, lit);
        if (casters.faces.shape(0) != arrays.faces.shape(0)) refuse("casters: expected the faces of the scene");
        if (paths.further < 0 || paths.options.bounces < 2 + paths.further)
            refuse("bounces: expected at least 2 + further");
        const SceneView<T> scene = arrays.view(), casting = casters.view();
        std::vector<CurveRecords> found;
        SecondaryEdgeSamples of_chunks;
        unlocked(threads, [&](ThreadTeam& team) {
            GeometryWork done;
            const auto geometry = arrays.geometry(wanted, team, done);
            const BackwardInput<T> input{
                scene,   camera,      *geometry, image,
                nullptr, hits.view(), nullptr,   marked_faces("transparent", arrays, transparent)};
            found = record_curves(input, options, paths.seen, team, [&](const BackwardView<T>& view, GradientSink& to) {
                add(view, casting, to, of_chunks);
            });
        });
        return nb::make_tuple(curve_arrays(found, least, true, threads),
                              joined_rows(of_chunks.jump, size_t(lit.scene.channels)),
                              joined_rows(of_chunks.origin, 3));
    }
};

template <class T>
nb::tuple secondary_edge_samples(const SceneArrays<T>& arrays, const SceneArrays<T>& casters, const LitArrays& lit,
                                 const LitOptions& lit_options, int further, bool seen, const Camera& camera,
                                 const ImageOptions& image, const GradientOptions& options, int64_t samples,
                                 double least, int threads, const HitArrays<T>& hits,
                                 const std::optional<In<uint8_t, 1>>& transparent) {
    const LitPaths paths{lit.scene, lit_options, further, seen};
    return EdgeSampleInput<T>{arrays, casters, lit, camera, image, hits, transparent, least, threads}.samples(
        paths, options, {.topology = true, .parts = true},
        [&](const BackwardView<T>& view, const SceneView<T>& casting, GradientSink& to, SecondaryEdgeSamples& out) {
            add_secondary_edges(view, casting, paths, samples, Record{options.intrinsics}, to, out);
        });
}

template <class T>
nb::tuple surface_edge_samples(const SceneArrays<T>& arrays, const SceneArrays<T>& casters, const LitArrays& lit,
                               const LitOptions& lit_options, int further, bool crossings, bool alpha_edges,
                               const Camera& camera, const ImageOptions& image, const GradientOptions& options,
                               int64_t samples, double least, int threads, const HitArrays<T>& hits,
                               const std::optional<In<uint8_t, 1>>& transparent) {
    const LitPaths paths{lit.scene, lit_options, further, false};
    return EdgeSampleInput<T>{arrays, casters, lit, camera, image, hits, transparent, least, threads}.samples(
        paths, options, {.topology = true, .intersections = true},
        [&](const BackwardView<T>& view, const SceneView<T>& casting, GradientSink& to, SecondaryEdgeSamples& out) {
            add_surface_edges(view, casting, paths, {crossings, alpha_edges}, samples, to, out);
        });
}

}  // namespace

template <class T>
void bind_scene_secondary_edges(nb::class_<SceneArrays<T>>& scene) {
    scene.def("secondary_edge_samples", &secondary_edge_samples<T>, "casters"_a, "lit"_a, "lit_options"_a,
              nb::kw_only(), "further"_a, "seen"_a, "camera"_a, "image"_a, "options"_a, "samples"_a, "least"_a,
              "threads"_a, "hits"_a, "transparent"_a.none());
    scene.def("surface_edge_samples", &surface_edge_samples<T>, "casters"_a, "lit"_a, "lit_options"_a, nb::kw_only(),
              "further"_a, "crossings"_a, "alpha_edges"_a, "camera"_a, "image"_a, "options"_a, "samples"_a, "least"_a,
              "threads"_a, "hits"_a, "transparent"_a.none());
}
template void bind_scene_secondary_edges(nb::class_<SceneArrays<float>>&);
template void bind_scene_secondary_edges(nb::class_<SceneArrays<double>>&);

void bind_secondary_edges(nb::module_& m) {
    m.def("sample_growth", &sample_growth, "spp"_a);
    m.attr("USUAL_SPP") = int(usual_spp);
    m.attr("SHADOW_SAMPLES_A_PIXEL") = shadow_samples_a_pixel;
    m.def(
        "default_secondary_samples",
        [](int64_t width, int64_t height, int spp) { return default_secondary_samples(width, height, spp); }, "width"_a,
        "height"_a, "spp"_a);
}

}  // namespace edgegrad
