// Borders of what surfaces of paths of light see of one another, for images that are made in PyTorch.

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
#include "secondary/surface_edges.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

nb::object joined_rows(const std::vector<std::vector<double>>& parts, size_t width) {
    std::vector<double> out;
    for (const std::vector<double>& part : parts) out.insert(out.end(), part.begin(), part.end());
    return rows(std::move(out), {width});
}

// What both kinds of samples are recorded of. `casters`: the same faces as light meets them.
template <class T>
struct Asked {
    const SceneArrays<T>&arrays, &casters;
    const LitArrays& lit;
    const Camera& camera;
    const ImageOptions& image;
    const HitArrays<T>& hits;
    const std::optional<In<uint8_t, 1>>& transparent;
    double least;
    int threads;

    // As records of arrays with their first point alone, and of SecondaryEdgeSamples the jumps (S, channels) and
    // origins (S, 3), of which there are none where the camera sees the points. record(input, casters, team, samples)
    template <class Record>
    nb::tuple samples(const LitOptions& options, int further, GeometryWanted wanted, Record record) const {
        hits.check(arrays, camera), check_faces(arrays, lit);
        if (casters.faces.shape(0) != arrays.faces.shape(0)) refuse("casters: expected the faces of the scene");
        if (further < 0 || options.bounces < 2 + further) refuse("bounces: expected at least 2 + further");
        const SceneView<T> scene = arrays.view(), casting = casters.view();
        std::vector<CurveRecords> found;
        SecondaryEdgeSamples of_chunks;
        unlocked(threads, [&](ThreadTeam& team) {
            GeometryWork done;
            const auto geometry = arrays.geometry(wanted, team, done);
            found = record(BackwardInput<T>{scene, camera, *geometry, image, nullptr, hits.view(), nullptr,
                                            marked_faces("transparent", arrays, transparent)},
                           casting, team, of_chunks);
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
    return Asked<T>{arrays, casters, lit, camera, image, hits, transparent, least, threads}.samples(
        lit_options, further, {.topology = true, .parts = true},
        [&](const BackwardInput<T>& input, const SceneView<T>& casting, ThreadTeam& team, SecondaryEdgeSamples& out) {
            return record_secondary_edges(input, casting, options, {lit.scene, lit_options, further, seen}, samples,
                                          team, out);
        });
}

template <class T>
nb::tuple surface_edge_samples(const SceneArrays<T>& arrays, const SceneArrays<T>& casters, const LitArrays& lit,
                               const LitOptions& lit_options, int further, bool crossings, bool alpha_edges,
                               const Camera& camera, const ImageOptions& image, const GradientOptions& options,
                               int64_t samples, double least, int threads, const HitArrays<T>& hits,
                               const std::optional<In<uint8_t, 1>>& transparent) {
    return Asked<T>{arrays, casters, lit, camera, image, hits, transparent, least, threads}.samples(
        lit_options, further, {.topology = true, .intersections = true},
        [&](const BackwardInput<T>& input, const SceneView<T>& casting, ThreadTeam& team, SecondaryEdgeSamples& out) {
            return record_surface_edges(input, casting, options, {lit.scene, lit_options, further, false},
                                        {crossings, alpha_edges}, samples, team, out);
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
    m.def("most_secondary_edge_samples", &most_secondary_edge_samples, "width"_a, "height"_a, "spp"_a);
}

}  // namespace edgegrad
