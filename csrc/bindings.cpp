// Checks, array views, exceptions; nothing else. Tensors come as NumPy views without a copy, outputs are arrays that
// the caller made, and the interpreter's lock is released while the kernel works.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <type_traits>
#include <vector>

#include "render.h"
#include "stopwatch.h"
#include "unlocked.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace edgegrad {

void bind_pieces(nb::module_& m);  // pieces.cpp

namespace {

template <class T, int Dimensions>
using In = nb::ndarray<const T, nb::numpy, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;
template <class T, int Dimensions>
using Out = nb::ndarray<T, nb::numpy, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;

[[noreturn]] void refuse(const std::string& text) { throw nb::value_error(text.c_str()); }

std::string at(int64_t index, int64_t width) {
    return width == 1 ? "[" + std::to_string(index) + "]"
                      : "[" + std::to_string(index / width) + ", " + std::to_string(index % width) + "]";
}

std::string text(double number) {
    char out[32];
    std::snprintf(out, sizeof out, "%g", number);
    return out;
}

// Looks at blocks of numbers, on several threads where these save more than they cost: whether all pass.
template <class T, class Pass>
bool all_pass(const T* values, int64_t n, int threads, Pass pass) {
    constexpr int64_t block = 1 << 16, parallel_from = 1 << 18;
    if (n <= parallel_from) return pass(values, n);
    std::atomic<bool> all{true};
    Team(threads).each((n + block - 1) / block, [&](int64_t k) {
        if (all && !pass(values + k * block, std::min(block, n - k * block))) all = false;
    });
    return all;
}

// What leaves the range of floats is refused too: the squares and products of such numbers would leave that of doubles.
template <class T>
constexpr T largest = T(std::numeric_limits<float>::max());

// Whether all are numbers up to the largest. Several counts, for one would wait for each addition.
constexpr int counts = 16;
template <class T>
EDGEGRAD_VECTORIZED bool are_finite(const T* values, int64_t n) {
    T bad[counts] = {};
    int64_t i = 0;
    for (; i + counts <= n; i += counts)
        for (int k = 0; k < counts; ++k) bad[k] += std::fabs(values[i + k]) <= largest<T> ? T(0) : T(1);
    for (; i < n; ++i) bad[0] += std::fabs(values[i]) <= largest<T> ? T(0) : T(1);
    for (int k = 1; k < counts; ++k) bad[0] += bad[k];
    return bad[0] == 0;
}

template <class T>
void check_finite(const char* name, const T* values, int64_t n, int64_t width, int threads) {
    if (all_pass(values, n, threads, are_finite<T>)) return;
    for (int64_t i = 0; i < n; ++i)
        if (!(std::fabs(values[i]) <= largest<T>))
            refuse(std::string(name) + ": expected " +
                   (std::isfinite(values[i]) ? "numbers up to 3.4e38" : "finite numbers") + ", got " + text(values[i]) +
                   " at " + at(i, width));
}

// Whether all are from 0 to count − 1: else one of v and count − 1 − v has its sign bit set.
template <class T>
EDGEGRAD_VECTORIZED bool are_below(const T* values, int64_t n, T count) {
    using U = std::make_unsigned_t<T>;
    U signs = 0;
    for (int64_t i = 0; i < n; ++i) signs |= U(values[i]) | (U(count) - 1 - U(values[i]));
    return T(signs) >= 0;
}

template <class T>
bool all_below(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, T count, int threads) {
    return all_pass(array.data(), array.size(), threads, [=](const T* v, int64_t n) { return are_below(v, n, count); });
}

template <class T>
bool all_finite(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, int threads) {
    return all_pass(array.data(), array.size(), threads, are_finite<T>);
}

// `n` indices, in rows of three, of which the first is number `first`.
void check_indices(const char* name, const int32_t* values, int64_t n, int64_t count, const char* of, int threads,
                   int64_t first = 0) {
    if (all_pass(values, n, threads, [=](const int32_t* v, int64_t m) { return are_below(v, m, int32_t(count)); }))
        return;
    for (int64_t i = 0; i < n; ++i)
        if (values[i] < 0 || values[i] >= count)
            refuse(std::string(name) + ": expected indices from 0 to " + std::to_string(count - 1) + " (rows of " + of +
                   "), got " + std::to_string(values[i]) + " at " + at(first + i, 3));
}

// From pairs of numbers: a vertex, and the spacing from there on.
Spacing make_spacing(const std::vector<double>& pairs) {
    Spacing spacing{{}, {}};
    for (size_t i = 0; i + 1 < pairs.size(); i += 2)
        spacing.first.push_back(int32_t(pairs[i])), spacing.value.push_back(pairs[i + 1]);
    if (pairs.empty() || pairs.size() % 2 || spacing.first[0] != 0 ||
        !std::is_sorted(spacing.first.begin(), spacing.first.end()))
        refuse("spacing: expected pairs of a vertex and a spacing, ascending from vertex 0");
    return spacing;
}

// The arrays of a scene, kept alive, checked, and seen as the kernel sees them.
template <class T>
struct SceneArrays {
    In<double, 2> verts;
    In<int32_t, 2> faces, corners;
    In<T, 2> colors;
    In<double, 2> uvs;
    In<T, 2> texels;
    In<int64_t, 2> textures;
    In<int32_t, 1> face_texture;
    In<T, 3> background;  // (1, 1, C) or (H, W, C)
    Spacing spacing;
    bool by_vertex = false;

    SceneArrays(In<double, 2> verts_, In<int32_t, 2> faces_, In<int32_t, 2> corners_, In<T, 2> colors_,
                In<double, 2> uvs_, In<T, 2> texels_, In<int64_t, 2> textures_, In<int32_t, 1> face_texture_,
                In<T, 3> background_, const std::vector<double>& spacing_, int threads)
        : verts(verts_),
          faces(faces_),
          corners(corners_),
          colors(colors_),
          uvs(uvs_),
          texels(texels_),
          textures(textures_),
          face_texture(face_texture_),
          background(background_),
          spacing(make_spacing(spacing_)) {
        const auto width = [](const char* name, size_t got, size_t expected) {
            if (got != expected)
                refuse(std::string(name) + ": expected " + std::to_string(expected) + " columns, got " +
                       std::to_string(got));
        };
        const size_t C = background.shape(2);
        width("verts", verts.shape(1), 3), width("faces", faces.shape(1), 3), width("corners", corners.shape(1), 3);
        width("colors", colors.shape(1), C), width("uvs", uvs.shape(1), 2), width("texels", texels.shape(1), C);
        width("textures", textures.shape(1), 3);
        if (corners.shape(0) != faces.shape(0)) refuse("corners: expected one row a face");
        if (faces.shape(0) == 0 || verts.shape(0) == 0) refuse("faces: expected at least one face, got none");
        check_finite("verts", verts.data(), verts.size(), 3, threads);
        check_finite("colors", colors.data(), colors.size(), C, threads);
        check_finite("uvs", uvs.data(), uvs.size(), 2, threads);
        check_finite("texture", texels.data(), texels.size(), C, threads);
        check_finite("background", background.data(), background.size(), C, threads);
        check_indices("faces", faces.data(), faces.size(), verts.shape(0), "verts", threads);
        const bool textured = textures.shape(0) > 0;
        if (!textured) {
            // Colours of vertices are indexed by the faces, or by a copy of them.
            by_vertex = colors.shape(0) >= verts.shape(0) &&
                        (corners.data() == faces.data() ||
                         std::equal(faces.data(), faces.data() + faces.size(), corners.data()));
            if (by_vertex) return;
            check_indices("colors", corners.data(), corners.size(), colors.shape(0), "colors", threads);
            return;
        }
        if (face_texture.shape(0) != faces.shape(0)) refuse("face_texture: expected one number a face");
        for (size_t i = 0; i < textures.shape(0); ++i) {
            const int64_t first = textures(i, 0), h = textures(i, 1), w = textures(i, 2);
            if (h < 1 || w < 1 || first < 0 || first + h * w > int64_t(texels.shape(0)))
                refuse("textures: row " + std::to_string(i) + " lies outside the texels");
        }
        for (size_t f = 0; f < faces.shape(0); ++f) {
            if (face_texture(f) >= int64_t(textures.shape(0)))
                refuse("face_texture: expected a texture's number, got " + std::to_string(face_texture(f)));
            const bool t = face_texture(f) >= 0;
            check_indices(t ? "uv_faces" : "colors", corners.data() + 3 * f, 3, t ? uvs.shape(0) : colors.shape(0),
                          t ? "uvs" : "colors", 1, 3 * f);
        }
    }

    SceneView<T> view() const {
        return {verts.data(),
                int64_t(verts.shape(0)),
                faces.data(),
                int64_t(faces.shape(0)),
                by_vertex ? faces.data() : corners.data(),  // one array: neighbours agree at their edge (may_jump)
                colors.data(),
                int64_t(colors.shape(0)),
                uvs.data(),
                int64_t(uvs.shape(0)),
                texels.data(),
                int64_t(texels.shape(0)),
                textures.data(),
                textures.shape(0) ? face_texture.data() : nullptr,
                background.data(),
                background.shape(0) * background.shape(1) > 1,
                int(background.shape(2))};
    }

    std::shared_ptr<const Geometry> geometry(GeometryWanted wanted, Team& team, GeometryWork& work) const {
        return acquire_geometry(faces.data(), faces.shape(0), verts.data(), verts.shape(0), spacing, wanted, team,
                                work);
    }
};

Camera make_camera(In<double, 2> world_to_camera, In<double, 2> K, bool perspective, int width, int height) {
    if (world_to_camera.shape(0) != 4 || world_to_camera.shape(1) != 4)
        refuse("world_to_camera: expected shape (4, 4)");
    if (K.shape(0) != 3 || K.shape(1) != 3) refuse("K: expected shape (3, 3)");
    check_finite("world_to_camera", world_to_camera.data(), 16, 4, 1);
    check_finite("K", K.data(), 9, 3, 1);
    const Camera camera(world_to_camera.data(), K.data(), perspective, width, height);
    if (camera.k_det == 0) refuse("K: expected focal lengths that are not zero, got a singular matrix");
    return camera;
}

Filter make_filter(const std::string& name) {
    if (name == "box") return Filter(FilterKind::box);
    if (name == "tent") return Filter(FilterKind::tent);
    if (name == "gaussian") return Filter(FilterKind::gaussian);
    refuse("filter: expected \"box\", \"tent\" or \"gaussian\", got \"" + name + "\"");
}

template <class T>
void check_image(const char* name, const Out<T, 3>& image, const Camera& camera, size_t channels) {
    if (int(image.shape(0)) != camera.height || int(image.shape(1)) != camera.width || image.shape(2) != channels)
        refuse(std::string(name) + ": expected an image of the camera's size and the scene's channels");
}

template <class T>
void check_background(const SceneArrays<T>& scene, const Camera& camera) {
    const auto& b = scene.background;
    if (b.shape(0) * b.shape(1) > 1 && (int(b.shape(0)) != camera.height || int(b.shape(1)) != camera.width))
        refuse("background: expected the size of the image, " + std::to_string(camera.height) + " x " +
               std::to_string(camera.width) + ", got " + std::to_string(b.shape(0)) + " x " +
               std::to_string(b.shape(1)));
}

// What a pass did, by name: counts, and seconds.
using Profile = std::map<std::string, double>;

template <class T>
void check_forward_output(const SceneArrays<T>& scene, const Camera& camera, const Out<T, 2>& coverage,
                          const Out<float, 2>& depth, const Out<int32_t, 3>& hit, const Out<uint8_t, 1>& seen) {
    if (coverage.size() != size_t(camera.width) * camera.height) refuse("coverage: expected the size of the image");
    if (depth.size() != coverage.size()) refuse("depth: expected one number a pixel");
    if (hit.size() != 2 * coverage.size()) refuse("hit: expected two numbers a pixel");
    if (seen.size() != scene.faces.shape(0)) refuse("seen: expected one number a face");
}

template <class T>
Profile forward(const SceneArrays<T>& scene, const Camera& camera, int spp, const std::string& filter, uint64_t seed,
                int threads, Out<T, 3> image, Out<T, 2> coverage, Out<float, 2> depth, Out<int32_t, 3> hit,
                Out<uint8_t, 1> seen) {
    check_background(scene, camera);
    check_image("image", image, camera, scene.background.shape(2));
    check_forward_output(scene, camera, coverage, depth, hit, seen);
    const ForwardOptions options{spp, make_filter(filter), seed};
    return unlocked(threads, [&](Team& team) -> Profile {
        Stopwatch watch;
        GeometryWork work;
        const auto geometry = scene.geometry({}, team, work);
        const double update = watch.lap();
        render_forward(scene.view(), camera, geometry->caster(), options, team,
                       ForwardOutput<T>{image.data(), coverage.data(), depth.data(), hit.data(), seen.data()});
        return {{"update", update}, {"forward", watch.lap()}, {"built rays", work.rays}};
    });
}

template <class T>
Profile backward(const SceneArrays<T>& scene, const Camera& camera, int spp, int64_t surface_samples,
                 int64_t edge_samples, const std::string& filter, uint64_t seed, int threads, bool interior_geometry,
                 bool boundary, bool dry, Out<T, 3> adjoint, Out<T, 2> coverage, Out<float, 2> depth,
                 Out<int32_t, 3> hit, Out<uint8_t, 1> seen, std::optional<Out<double, 2>> verts,
                 std::optional<Out<double, 2>> colors, std::optional<Out<double, 2>> uvs,
                 std::optional<Out<double, 2>> texels, std::optional<Out<double, 3>> background,
                 std::optional<Out<double, 2>> world_to_camera, std::optional<Out<double, 2>> K) {
    check_background(scene, camera);
    check_image("adjoint", adjoint, camera, scene.background.shape(2));
    check_forward_output(scene, camera, coverage, depth, hit, seen);
    check_finite("the gradient of the image", adjoint.data(), adjoint.size(), adjoint.shape(2), threads);
    const auto data = [](auto& array, const auto& like, const char* name) -> double* {
        if (!array) return nullptr;
        if (array->size() != like.size()) refuse(std::string("gradient of ") + name + ": expected the size of " + name);
        return array->data();
    };
    SceneGrad grad;
    grad.verts = data(verts, scene.verts, "verts"), grad.colors = data(colors, scene.colors, "colors");
    grad.uvs = data(uvs, scene.uvs, "uvs"), grad.texels = data(texels, scene.texels, "texels");
    grad.background = data(background, scene.background, "background");
    if (world_to_camera && world_to_camera->size() != 16) refuse("gradient of world_to_camera: expected shape (4, 4)");
    if (K && K->size() != 9) refuse("gradient of K: expected shape (3, 3)");
    grad.world_to_camera = world_to_camera ? world_to_camera->data() : nullptr;
    grad.K = K ? K->data() : nullptr;
    const BackwardOptions options{.spp = spp,
                                  .surface_samples = surface_samples,
                                  .edge_samples = edge_samples,
                                  .filter = make_filter(filter),
                                  .seed = seed,
                                  .interior_geometry = interior_geometry,
                                  .boundary = boundary,
                                  .spacing = scene.spacing,
                                  .dry = dry};
    GeometryWork work;
    double update = 0;
    const BackwardProfile p = unlocked(threads, [&](Team& team) {
        Stopwatch watch;
        const bool interior = (grad.geometry() && interior_geometry) || grad.appearance();
        const auto geometry =
            scene.geometry({grad.geometry() && boundary, interior || (grad.geometry() && boundary)}, team, work);
        update = watch.lap();
        return render_backward(scene.view(), camera, *geometry, options, team, adjoint.data(),
                               ForwardView<T>{coverage.data(), depth.data(), hit.data(), seen.data()}, grad);
    });
    return {{"surface_samples", double(p.surface_samples)},
            {"edge_samples", double(p.edge_samples)},
            {"surface_wanted", double(p.surface_wanted)},
            {"edge_wanted", double(p.edge_wanted)},
            {"silhouettes", double(p.silhouettes)},
            {"creases", double(p.creases)},
            {"built rays", work.rays},
            {"built edges", work.edges},
            {"update", update},
            {"view", p.view},
            {"surface measure", p.measure},
            {"surface rays", p.surface[0]},
            {"surface scatter", p.surface[1]},
            {"curves", p.curves},
            {"edge rays", p.edge[0]},
            {"edge scatter", p.edge[1]},
            {"world", p.world}};
}

template <class T>
void bind_scene(nb::module_& m, const char* name) {
    using Scene = SceneArrays<T>;
    nb::class_<Scene>(m, name)
        .def(nb::init<In<double, 2>, In<int32_t, 2>, In<int32_t, 2>, In<T, 2>, In<double, 2>, In<T, 2>, In<int64_t, 2>,
                      In<int32_t, 1>, In<T, 3>, const std::vector<double>&, int>(),
             "verts"_a.noconvert(), "faces"_a.noconvert(), "corners"_a.noconvert(), "colors"_a.noconvert(),
             "uvs"_a.noconvert(), "texels"_a.noconvert(), "textures"_a.noconvert(), "face_texture"_a.noconvert(),
             "background"_a.noconvert(), "spacing"_a, "threads"_a)
        .def("forward", &forward<T>, "camera"_a, "spp"_a, "filter"_a, "seed"_a, "threads"_a, "image"_a.noconvert(),
             "coverage"_a.noconvert(), "depth"_a.noconvert(), "hit"_a.noconvert(), "seen"_a.noconvert())
        .def(
            "bare_loop",
            [](const Scene& scene, const Camera& camera, int spp, const std::string& filter, uint64_t seed,
               int packet_width, int threads) {
                const ForwardOptions options{spp, make_filter(filter), seed};
                return unlocked(threads, [&](Team& team) {
                    GeometryWork work;
                    return bare_loop(camera, scene.geometry({}, team, work)->caster(), options, packet_width, team);
                });
            },
            "camera"_a, "spp"_a, "filter"_a, "seed"_a, "packet_width"_a, "threads"_a)
        .def(
            "pixel_backward",
            [](const Scene& scene, const Camera& camera, int spp, const std::string& filter, uint64_t seed, int threads,
               Out<T, 3> adjoint, Out<double, 2> verts, std::optional<Out<double, 2>> colors) {
                BackwardOptions options{spp, -1, -1, make_filter(filter), seed, true, false, scene.spacing, false};
                options.pixel_spp = spp;
                SceneGrad grad;
                grad.verts = verts.data(), grad.colors = colors ? colors->data() : nullptr;
                return unlocked(threads, [&](Team& team) {
                    const std::vector<uint8_t> seen(scene.faces.shape(0), 1);
                    GeometryWork work;
                    const auto geometry = scene.geometry({}, team, work);
                    const BackwardProfile p =
                        render_backward(scene.view(), camera, *geometry, options, team, adjoint.data(),
                                        ForwardView<T>{.seen = seen.data()}, grad);
                    return p.surface[0] + p.surface[1];
                });
            },
            "camera"_a, "spp"_a, "filter"_a, "seed"_a, "threads"_a, "adjoint"_a.noconvert(), "verts"_a.noconvert(),
            "colors"_a = nb::none())
        .def("backward", &backward<T>, "camera"_a, "spp"_a, "surface_samples"_a, "edge_samples"_a, "filter"_a, "seed"_a,
             "threads"_a, "interior_geometry"_a, "boundary"_a, "dry"_a, "adjoint"_a.noconvert(),
             "coverage"_a.noconvert(), "depth"_a.noconvert(), "hit"_a.noconvert(), "seen"_a.noconvert(),
             "verts"_a = nb::none(), "colors"_a = nb::none(), "uvs"_a = nb::none(), "texels"_a = nb::none(),
             "background"_a = nb::none(), "world_to_camera"_a = nb::none(), "K"_a = nb::none())
        .def(
            "shade_at",
            [](const Scene& scene, const Camera& camera, In<int32_t, 1> faces, In<double, 2> points,
               Out<double, 2> radiance) {
                check_indices("faces", faces.data(), faces.size(), scene.faces.shape(0), "faces", 1);
                shade_at(scene.view(), camera, faces.size(), faces.data(), points.data(), radiance.data());
            },
            "camera"_a, "faces"_a.noconvert(), "points"_a.noconvert(), "radiance"_a.noconvert())
        .def(
            "shade_at_vjp",
            [](const Scene& scene, const Camera& camera, In<int32_t, 1> faces, In<double, 2> points,
               In<double, 2> radiance_bar, Out<double, 2> verts, Out<double, 2> colors, Out<double, 2> uvs,
               Out<double, 2> texels, Out<double, 2> world_to_camera, Out<double, 2> K) {
                check_indices("faces", faces.data(), faces.size(), scene.faces.shape(0), "faces", 1);
                SceneGrad grad;
                grad.verts = verts.data(), grad.colors = colors.data(), grad.uvs = uvs.data(),
                grad.texels = texels.data();
                grad.world_to_camera = world_to_camera.data(), grad.K = K.data();
                shade_at_vjp(scene.view(), camera, faces.size(), faces.data(), points.data(), radiance_bar.data(),
                             grad);
            },
            "camera"_a, "faces"_a.noconvert(), "points"_a.noconvert(), "radiance_bar"_a.noconvert(),
            "verts"_a.noconvert(), "colors"_a.noconvert(), "uvs"_a.noconvert(), "texels"_a.noconvert(),
            "world_to_camera"_a.noconvert(), "K"_a.noconvert());
}

}  // namespace

NB_MODULE(_core, m) {
    m.doc() = "The edgegrad kernel. Use it through the edgegrad package.";
    nb::set_leak_warnings(false);  // of a process that ends while a thread of it renders
    m.def("open_embree", &open_embree, "path"_a, "options"_a, nb::call_guard<Unlocked>());
    m.def("embree_version", &embree_version);
    m.def("packet_width", &packet_width);
    // Without the interpreter's lock, for which a thread that holds the kernel's may wait.
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
            after_fork(child);
        },
        "child"_a);
    nb::class_<Camera>(m, "Camera")
        .def(nb::new_(&make_camera), "world_to_camera"_a.noconvert(), "K"_a.noconvert(), "perspective"_a, "width"_a,
             "height"_a);
    bind_scene<float>(m, "SceneFloat");
    bind_scene<double>(m, "SceneDouble");
    bind_pieces(m);
}

}  // namespace edgegrad
