// Defines the kernel's module: records of options, and the two passes. Tensors arrive as NumPy views without a copy,
// and callers allocate the outputs. The interpreter's lock is released while the kernel works.

#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <iterator>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "backward/backward.h"
#include "core/openmp_runtime.h"
#include "core/stopwatch.h"
#include "forward/centers.h"
#include "python/arrays.h"
#include "python/unlocked.h"
#include "texture/texture.h"

using namespace nanobind::literals;

namespace edgegrad {

void bind_memory(nb::module_& m);           // memory.cpp
void bind_for_shaders(nb::module_& m);      // for_shaders.cpp
void bind_lit(nb::module_& m);              // lit.cpp
void bind_secondary_edges(nb::module_& m);  // secondary_edges.cpp
void bind_moving_hits(nb::module_& m);      // moving_hits.cpp
void bind_raster(nb::module_& m);           // raster.cpp
void bind_track(nb::module_& m);            // track.cpp
template <class T>
void bind_scene_for_shaders(nb::class_<SceneArrays<T>>& scene);
template <class T>
void bind_scene_lit(nb::class_<SceneArrays<T>>& scene);
template <class T>
void bind_scene_secondary_edges(nb::class_<SceneArrays<T>>& scene);

namespace {

template <class T>
void check_background(const SceneArrays<T>& scene, const Camera& camera) {
    const auto& b = scene.background;
    if (b.shape(0) * b.shape(1) > 1 && (int(b.shape(0)) != camera.height || int(b.shape(1)) != camera.width))
        refuse("background: expected the size of the image, " + std::to_string(camera.height) + " x " +
               std::to_string(camera.width) + ", got " + std::to_string(b.shape(0)) + " x " +
               std::to_string(b.shape(1)));
}

// Reports what a pass did, by name: counts, and seconds.
using Profile = std::map<std::string, double>;

template <class T>
Profile forward(const SceneArrays<T>& scene, const Camera& camera, const ChannelArrays& channels,
                const ImageOptions& options, int threads, Out<T, 3> image, const HitArrays<T>& hits) {
    check_background(scene, camera);
    check_image("image", image, camera, scene.background.shape(2));
    hits.check(scene, camera);
    const SceneView<T> view = scene.view(channels, threads);
    return unlocked(threads, [&](ThreadTeam& team) -> Profile {
        Stopwatch watch;
        GeometryWork work;
        const auto geometry = scene.geometry({}, team, work);
        const double update = watch.lap();
        render_forward(view, camera, geometry->caster(), options, team, image.data(), hits.view());
        return {{"update", update}, {"forward", watch.lap()}, {"built rays", work.rays}};
    });
}

template <class T>
void find_faces(const SceneArrays<T>& scene, const Camera& camera, const ChannelArrays& channels, int threads,
                Out<int32_t, 2> face) {
    if (int(face.shape(0)) != camera.height || int(face.shape(1)) != camera.width)
        refuse("face: expected one number a pixel");
    const SceneView<T> view = scene.view(channels, threads);
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        faces_at_centers(view, camera, scene.geometry({}, team, work)->caster(), team, face.data());
    });
}

// Maps the names of slots to arrays.
using GradientArrays = std::map<std::string, nb::ndarray<double, nb::numpy, nb::c_contig, nb::device::cpu>>;

template <class T>
Gradients make_gradients(const GradientArrays& arrays, const SceneView<T>& scene, const Camera& camera) {
    Gradients grad;
    for (const auto& [name, array] : arrays) {
        const auto slot = std::find_if(std::begin(gradient_slots<T>), std::end(gradient_slots<T>),
                                       [&](const GradientSlot<T>& s) { return name == s.name; });
        if (slot == std::end(gradient_slots<T>)) refuse("gradients: there is none of " + name);
        if (int64_t(array.size()) != slot->size(scene, int64_t(camera.width) * camera.height))
            refuse("gradient of " + name + ": expected the size of " + name);
        grad.*(slot->to) = array.data();
    }
    return grad;
}

template <class T>
Profile backward(const SceneArrays<T>& arrays, const Camera& camera, const ChannelArrays& channels,
                 const ImageOptions& image, const GradientOptions& options, int threads, Out<T, 3> adjoint,
                 const HitArrays<T>& hits, const GradientArrays& gradients,
                 const std::optional<In<uint8_t, 1>>& detailed) {
    check_background(arrays, camera);
    check_image("adjoint", adjoint, camera, arrays.background.shape(2));
    hits.check(arrays, camera);
    check_finite("the gradient of the image", adjoint.data(), adjoint.size(), adjoint.shape(2), threads);
    const SceneView<T> scene = arrays.view(channels, threads);
    const Gradients grad = make_gradients(gradients, scene, camera);
    GeometryWork work;
    double update = 0;
    const BackwardProfile p = unlocked(threads, [&](ThreadTeam& team) {
        Stopwatch watch;
        const bool boundary = grad.geometry() && options.boundary;
        const bool interior = (grad.geometry() && options.interior_geometry) || grad.appearance();
        const auto geometry = arrays.geometry(geometry_for(interior, boundary), team, work);
        update = watch.lap();
        return render_backward(BackwardInput<T>{scene, camera, *geometry, image, adjoint.data(), hits.view(),
                                                marked_faces("detailed", arrays, detailed)},
                               options, team, grad);
    });
    return {{"surface_samples", double(p.surface_samples)},
            {"edge_samples", double(p.edge_samples)},
            {"surface_wanted", double(p.surface_wanted)},
            {"edge_wanted", double(p.edge_wanted)},
            {"silhouettes", double(p.silhouettes)},
            {"creases", double(p.creases)},
            {"intersections", double(p.intersections)},
            {"lens_boundary", p.lens_boundary},
            {"built rays", work.rays},
            {"built edges", work.edges},
            {"found intersections", work.intersections},
            {"update", update},
            {"view", p.view},
            {"surface measure", p.measure},
            {"surface rays", p.surface[0]},
            {"surface scatter", p.surface[1]},
            {"curves", p.curves},
            {"edge rays", p.edge[0]},
            {"edge scatter", p.edge[1]},
            {"discontinuity_lines", double(p.discontinuity_lines)},
            {"discontinuity rays", p.discontinuity[0]},
            {"discontinuity scatter", p.discontinuity[1]},
            {"world", p.world}};
}

// Computes the derivatives in several directions, each given by slots.
template <class T>
void jvp(const SceneArrays<T>& arrays, const Camera& camera, const ChannelArrays& channels, const ImageOptions& image,
         const GradientOptions& options, int threads, Out<T, 3> adjoint, const HitArrays<T>& hits,
         const std::vector<GradientArrays>& tangents, Out<double, 4> image_dot) {
    check_background(arrays, camera);
    check_image("adjoint", adjoint, camera, arrays.background.shape(2));
    hits.check(arrays, camera);
    const SceneView<T> scene = arrays.view(channels, threads);
    std::vector<Tangents> directions;
    for (const GradientArrays& given : tangents) {
        const Gradients slots = make_gradients(given, scene, camera);
        Tangents& t = directions.emplace_back();
        for (const GradientSlot<T>& slot : gradient_slots<T>) t.*(slot.from) = slots.*(slot.to);
    }
    if (image_dot.size() != adjoint.size() * directions.size())
        refuse("image_dot: expected the image's size for each direction");
    with_geometry(arrays, options.boundary, threads, [&](const Geometry& geometry, ThreadTeam& team) {
        render_tangents(BackwardInput<T>{scene, camera, geometry, image, adjoint.data(), hits.view()}, options, team,
                        directions, image_dot.data());
    });
}

template <class T>
void screen_gradient(const SceneArrays<T>& arrays, const Camera& camera, const ChannelArrays& channels,
                     const ImageOptions& image, const GradientOptions& options, int threads, Out<T, 3> adjoint,
                     const HitArrays<T>& hits, Out<double, 3> gradient) {
    check_background(arrays, camera);
    check_image("adjoint", adjoint, camera, arrays.background.shape(2));
    hits.check(arrays, camera);
    check_finite("the gradient of the image", adjoint.data(), adjoint.size(), adjoint.shape(2), threads);
    if (gradient.size() != size_t(2) * camera.width * camera.height) refuse("gradient: expected two numbers a pixel");
    const SceneView<T> scene = arrays.view(channels, threads);
    with_geometry(arrays, options.boundary, threads, [&](const Geometry& geometry, ThreadTeam& team) {
        render_screen_gradient(BackwardInput<T>{scene, camera, geometry, image, adjoint.data(), hits.view()}, options,
                               team, gradient.data());
    });
}

template <class T>
void bind_scene(nb::module_& m, const char* scene_name, const char* hits_name) {
    using Scene = SceneArrays<T>;
    nb::class_<HitArrays<T>>(m, hits_name)
        .def(nb::new_([](Out<T, 2> coverage, Out<float, 2> depth, Out<int32_t, 3> hit, Out<uint8_t, 1> seen) {
                 return HitArrays<T>{coverage, depth, hit, seen};
             }),
             "coverage"_a.noconvert(), "depth"_a.noconvert(), "hit"_a.noconvert(), "seen"_a.noconvert());
    nb::class_<Scene> scene(m, scene_name);
    scene
        .def(nb::init<In<double, 2>, In<int32_t, 2>, In<int32_t, 2>, In<T, 2>, In<double, 2>, In<T, 2>, In<int64_t, 2>,
                      In<int32_t, 1>, In<int32_t, 2>, In<T, 2>, In<int64_t, 2>, In<int32_t, 1>, In<T, 3>,
                      const std::vector<double>&, const std::vector<double>&, int>(),
             "verts"_a.noconvert(), "faces"_a.noconvert(), "corners"_a.noconvert(), "colors"_a.noconvert(),
             "uvs"_a.noconvert(), "texels"_a.noconvert(), "textures"_a.noconvert(), "face_texture"_a.noconvert(),
             "uv_corners"_a.noconvert(), "alphas"_a.noconvert(), "alpha_masks"_a.noconvert(),
             "face_alpha_mask"_a.noconvert(), "background"_a.noconvert(), "cutoffs"_a, "spacing"_a, "threads"_a)
        .def("forward", &forward<T>, "camera"_a, "channels"_a, "options"_a, "threads"_a, "image"_a.noconvert(),
             "hits"_a)
        .def("faces_at_centers", &find_faces<T>, "camera"_a, "channels"_a, "threads"_a, "face"_a.noconvert())
        .def("backward", &backward<T>, "camera"_a, "channels"_a, "image"_a, "options"_a, "threads"_a,
             "adjoint"_a.noconvert(), "hits"_a, "gradients"_a, "detailed"_a.none() = nb::none())
        .def("jvp", &jvp<T>, "camera"_a, "channels"_a, "image"_a, "options"_a, "threads"_a, "adjoint"_a.noconvert(),
             "hits"_a, "tangents"_a, "image_dot"_a.noconvert())
        .def("screen_gradient", &screen_gradient<T>, "camera"_a, "channels"_a, "image"_a, "options"_a, "threads"_a,
             "adjoint"_a.noconvert(), "hits"_a, "gradient"_a.noconvert());
    bind_scene_for_shaders(scene);
    bind_scene_lit(scene);
    bind_scene_secondary_edges(scene);
}

}  // namespace

NB_MODULE(_core, m) {
    m.doc() = "The edgegrad kernel. Use it through the edgegrad package.";
    nb::set_leak_warnings(false);  // A process may end while one of its threads renders.
    m.def("open_embree", &open_embree, "path"_a, "options"_a, nb::call_guard<Unlocked>());
    m.def("embree_version", &embree_version);
    m.def("packet_width", &packet_width);
    m.def("openmp_runtime", &openmp_runtime);
    // These release the interpreter's lock, because a thread that holds the kernel's lock may wait for it.
    m.def("all_finite", &all_finite<float>, "array"_a.noconvert(), "threads"_a = 1);
    m.def("all_finite", &all_finite<double>, "array"_a.noconvert(), "threads"_a = 1);
    m.def("all_below", &all_below<int32_t>, "array"_a.noconvert(), "count"_a, "threads"_a = 1);
    m.def("all_below", &all_below<int64_t>, "array"_a.noconvert(), "count"_a, "threads"_a = 1);
    m.def("clear_geometry", &clear_geometry, nb::call_guard<Unlocked>());
    m.def("await_callers", &await_callers, nb::call_guard<nb::gil_scoped_release>());
    m.def("before_fork", &before_fork, nb::call_guard<Unlocked>());
    m.def(
        "after_fork",
        [](bool child) {
            if (child) forget_other_callers();
            after_fork();
        },
        "child"_a);
    nb::class_<Camera>(m, "Camera")
        .def(nb::new_(&make_camera), "world_to_camera"_a.noconvert(), "K"_a.noconvert(), "distortion"_a.noconvert(),
             "perspective"_a, "lens"_a, "width"_a, "height"_a, "by_distortion"_a = true)
        // Returns the angle to the axis where the lens folds over or ends in the image, if it does.
        .def_prop_ro("end", [](const Camera& c) { return c.lens_view.end; })
        // Returns how many pinholes it sees through.
        .def_prop_ro("sides", [](const Camera& c) { return sub_cameras_for_rays(c).size(); });
    nb::class_<ChannelArrays>(m, "Channels")
        .def(nb::init<In<double, 2>, In<double, 2>, bool, bool, bool, int>(), "vertex_attributes"_a.noconvert(),
             "face_attributes"_a.noconvert(), "alpha"_a, "barycentrics"_a, "uv"_a, "unit"_a);
    nb::class_<ImageOptions>(m, "ImageOptions").def(nb::new_(&make_image_options), "spp"_a, "filter"_a, "seed"_a);
    nb::class_<GradientOptions>(m, "GradientOptions")
        .def(nb::new_([](uint64_t seed, int64_t surface_samples, int64_t edge_samples, bool interior_geometry,
                         bool boundary, bool intrinsics, bool discontinuities, double discontinuity_spacing, bool lit,
                         bool indirect, bool dry) {
                 return GradientOptions{
                     surface_samples, edge_samples,          seed, interior_geometry, boundary, intrinsics,
                     discontinuities, discontinuity_spacing, lit,  indirect,          dry,      !dry};
             }),
             "seed"_a, nb::kw_only(), "surface_samples"_a = -1, "edge_samples"_a = -1, "interior_geometry"_a = true,
             "boundary"_a = true, "intrinsics"_a = true, "discontinuities"_a = true, "discontinuity_spacing"_a = 1.0,
             "lit"_a = false, "indirect"_a = false, "dry"_a = false);
    m.attr("WRAPS") = nb::make_tuple(wrap_names[0], wrap_names[1], wrap_names[2]);
    m.attr("TEXTURE_FILTERS") = nb::make_tuple(texture_filter_names[0], texture_filter_names[1]);
    std::vector<std::string> slots;
    for (const auto& slot : gradient_slots<double>) slots.push_back(slot.name);
    m.attr("GRADIENT_SLOTS") = nb::tuple(nb::cast(slots));
    bind_for_shaders(m);
    bind_lit(m);
    bind_secondary_edges(m);
    bind_moving_hits(m);
    bind_raster(m);
    bind_track(m);
    bind_scene<float>(m, "SceneFloat", "HitsFloat");
    bind_scene<double>(m, "SceneDouble", "HitsDouble");
    bind_memory(m);
}

}  // namespace edgegrad
