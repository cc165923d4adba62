// Defines the module of what only tests and benchmarks call. These are small functions with their _vjp, and parts of
// topology and sampling for comparison with their definitions. Others are samples of one pass alone, and the reference
// loop of rays.

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <optional>
#include <tuple>
#include <vector>

#include "backward/backward.h"
#include "camera/camera.h"
#include "camera/face_map.h"
#include "camera/sub_cameras.h"
#include "checks/probe.h"
#include "core/sampler.h"
#include "core/sobol.h"
#include "core/systematic.h"
#include "film/film.h"
#include "film/importance.h"
#include "forward/forward.h"
#include "python/arrays.h"
#include "python/unlocked.h"
#include "rays/embree.h"
#include "scene/intersections.h"
#include "scene/topology.h"
#include "texture/texture.h"

using namespace nanobind::literals;

namespace edgegrad {

void bind_paths_for_tests(nb::module_& m);  // paths_for_tests.cpp
void bind_track_for_tests(nb::module_& m);  // track_for_tests.cpp

namespace {

using A2 = std::array<double, 2>;
using A3 = std::array<double, 3>;
using A33 = std::array<A3, 3>;

Vec2 vec(const A2& a) { return {a[0], a[1]}; }
Vec3 vec(const A3& a) { return {a[0], a[1], a[2]}; }
FaceMap map(const A33& m) { return {{vec(m[0]), vec(m[1]), vec(m[2])}}; }
A2 array(Vec2 a) { return {a.x, a.y}; }
A3 array(Vec3 a) { return {a.x, a.y, a.z}; }
template <size_t N>
std::array<double, N> array(const double (&a)[N]) {
    return std::to_array(a);
}
// These convert tangents of K and of the coefficients from one array, and cotangents to two arrays.
IntrinsicsGrad intrinsics(const Camera& c, const std::array<double, 6 + most_coefficients>& dot) {
    return sub_camera_intrinsics(c, dot.data(), dot.data() + 6);
}
std::tuple<std::array<double, 6>, std::array<double, most_coefficients>> of_camera(const Camera& c,
                                                                                   const IntrinsicsGrad& bar) {
    std::array<double, 6> k{};
    std::array<double, most_coefficients> distortion{};
    add_intrinsics(c, bar, k.data(), distortion.data());
    return {k, distortion};
}
A33 array(const FaceMap& m) { return {array(m.column[0]), array(m.column[1]), array(m.column[2])}; }

FilterKind kind(const std::string& name) {
    return name == "box" ? FilterKind::box : name == "tent" ? FilterKind::tent : FilterKind::gaussian;
}

// Binds functions of a whole scene.
template <class T>
void bind_scene_functions(nb::module_& m) {
    using Scene = SceneArrays<T>;
    m.def(
        "bare_loop",
        [](const Scene& scene, const Camera& camera, const ImageOptions& options, int packet_width, int threads) {
            return unlocked(threads, [&](ThreadTeam& team) {
                GeometryWork work;
                return bare_loop(camera, scene.geometry({}, team, work)->caster(), options, packet_width, team);
            });
        },
        "scene"_a, "camera"_a, "options"_a, "packet_width"_a, "threads"_a);
    // Casts any rays; ray i ignores the faces ignored[first[i]] … ignored[first[i + 1] − 1].
    m.def(
        "cast_rays",
        [](const Scene& scene, In<double, 2> origins, In<double, 2> directions, In<double, 1> ends,
           In<int32_t, 1> ignored, In<int64_t, 1> first, Out<int32_t, 1> face, Out<uint8_t, 1> hidden) {
            return unlocked(1, [&](ThreadTeam& team) {
                GeometryWork work;
                const auto geometry = scene.geometry({}, team, work);
                cast_rays(geometry->caster(), {origins.data(), directions.data(), ends.data(), int64_t(ends.size())},
                          {ignored.data(), first.data()}, face.data(), hidden.data());
            });
        },
        "scene"_a, "origins"_a.noconvert(), "directions"_a.noconvert(), "ends"_a.noconvert(), "ignored"_a.noconvert(),
        "first"_a.noconvert(), "face"_a.noconvert(), "hidden"_a.noconvert());
    // Computes the interior term from samples of the pixels.
    m.def(
        "pixel_backward",
        [](const Scene& scene, const Camera& camera, const ImageOptions& image, int threads, Out<T, 3> adjoint,
           Out<double, 2> verts, std::optional<Out<double, 2>> colors) {
            const GradientOptions options{.seed = image.seed, .boundary = false, .pixel_spp = image.spp};
            const Gradients grad{.verts = verts.data(), .colors = colors ? colors->data() : nullptr};
            return unlocked(threads, [&](ThreadTeam& team) {
                std::vector<uint8_t> seen(scene.faces.shape(0), 1);
                GeometryWork work;
                const auto geometry = scene.geometry({}, team, work);
                const SceneView<T> view = scene.view();
                const BackwardInput<T> input{view, camera, *geometry, image, adjoint.data(), {.seen = seen.data()}};
                const BackwardProfile p = render_backward(input, options, team, grad);
                return p.surface[0] + p.surface[1];
            });
        },
        "scene"_a, "camera"_a, "image"_a, "threads"_a, "adjoint"_a.noconvert(), "verts"_a.noconvert(),
        "colors"_a = nb::none());
    m.def(
        "shade_at",
        [](const Scene& scene, const Camera& camera, In<int32_t, 1> faces, In<double, 2> points,
           Out<double, 2> radiance) {
            check_indices("faces", faces.data(), faces.size(), scene.faces.shape(0), "faces", 1);
            shade_at(scene.view(), camera, faces.size(), faces.data(), points.data(), radiance.data());
        },
        "scene"_a, "camera"_a, "faces"_a.noconvert(), "points"_a.noconvert(), "radiance"_a.noconvert());
    m.def(
        "shade_at_vjp",
        [](const Scene& scene, const Camera& camera, In<int32_t, 1> faces, In<double, 2> points,
           In<double, 2> radiance_bar, Out<double, 2> verts, Out<double, 2> colors, Out<double, 2> uvs,
           Out<double, 2> texels, Out<double, 2> world_to_camera, Out<double, 2> K) {
            check_indices("faces", faces.data(), faces.size(), scene.faces.shape(0), "faces", 1);
            const Gradients grad{.verts = verts.data(),
                                 .colors = colors.data(),
                                 .uvs = uvs.data(),
                                 .texels = texels.data(),
                                 .world_to_camera = world_to_camera.data(),
                                 .K = K.data()};
            shade_at_vjp(scene.view(), camera, faces.size(), faces.data(), points.data(), radiance_bar.data(), grad);
        },
        "scene"_a, "camera"_a, "faces"_a.noconvert(), "points"_a.noconvert(), "radiance_bar"_a.noconvert(),
        "verts"_a.noconvert(), "colors"_a.noconvert(), "uvs"_a.noconvert(), "texels"_a.noconvert(),
        "world_to_camera"_a.noconvert(), "K"_a.noconvert());
}

}  // namespace

NB_MODULE(_core_tests, p) {
    p.doc() = "What only tests and benchmarks call. It holds the kernel once more, but its classes are those of _core.";
    nb::set_leak_warnings(false);
    p.def("open_embree", &open_embree, "path"_a, "options"_a, nb::call_guard<Unlocked>());
    bind_scene_functions<float>(p);
    bind_scene_functions<double>(p);
    bind_paths_for_tests(p);
    bind_track_for_tests(p);

    p.def("project", [](const Camera& c, A3 q) { return array(distort(c, project(c, vec(q))).x); });
    p.def("project_straight", [](const Camera& c, A3 q) { return array(project(c, vec(q))); });
    p.def("project_vjp", [](const Camera& c, A3 q, A2 bar) {
        Vec3 q_bar;
        IntrinsicsGrad grad;
        project_vjp(c, vec(q), vec(bar), q_bar, grad);
        const auto [k, distortion] = of_camera(c, grad);
        return std::tuple(array(q_bar), k, distortion);
    });
    p.def("normalised", [](const Camera& c, A2 x) { return array(normalised(c, undistort(c, vec(x)))); });
    p.def("normalised_vjp", [](const Camera& c, A2 x, A2 bar) {
        IntrinsicsGrad grad;
        normalised_vjp(c, normalised(c, undistort(c, vec(x))), vec(bar), grad);
        return of_camera(c, grad);
    });
    // Returns where the rays through points (N, 2) of the unit square of pixel (x, y) go.
    p.def("place_in_pixel", [](const Camera& c, int x, int y, const std::vector<A2>& places) {
        std::vector<double> n_x, n_y;
        for (const A2& u : places) n_x.push_back(u[0]), n_y.push_back(u[1]);
        place_in_pixel(c, Filter(FilterKind::box), x, y, int(places.size()), n_x.data(), n_y.data());
        std::vector<A2> out;
        for (size_t i = 0; i < places.size(); ++i) out.push_back({n_x[i], n_y[i]});
        return out;
    });
    // Distorts a point of the undistorted image. Returns its position, the area scale, and the distorted tangent.
    p.def("distort", [](const Camera& c, A2 u, A2 tangent) {
        const Distorted b = distort(c, vec(u));
        return std::tuple(array(b.x), b.area_scale, array(distort_jvp(c, normalised(c, vec(u)), vec(tangent))));
    });
    p.def("image_box", [](const Camera& c, A2 low, A2 high) {
        const auto [a, b] = c.image_box(vec(low), vec(high));
        return std::tuple(array(a), array(b));
    });
    // Returns the sub-cameras, with the rotations into their frames.
    p.def("sub_cameras", [](const Camera& c, double reach) {
        std::vector<std::tuple<Camera, A33>> out;
        for (const Camera& w : sub_cameras_for_points(c, reach))
            out.emplace_back(w, A33{array(w.rotation.row[0]), array(w.rotation.row[1]), array(w.rotation.row[2])});
        return out;
    });
    // Returns the box of its undistorted image.
    p.def("view_box", [](const Camera& c) { return std::tuple(array(c.lens_view.low), array(c.lens_view.high)); });
    // These are in forward mode.
    p.def("project_jvp", [](const Camera& c, A3 q, A3 q_dot, std::array<double, 6 + most_coefficients> k_dot) {
        return array(project_jvp(c, vec(q), vec(q_dot), intrinsics(c, k_dot)));
    });
    p.def("normalised_jvp", [](const Camera& c, A2 x, std::array<double, 6 + most_coefficients> k_dot) {
        return array(normalised_jvp(c, normalised(c, undistort(c, vec(x))), intrinsics(c, k_dot)));
    });
    p.def("face_map_jvp", [](const Camera& c, A33 q, A33 q_dot) {
        const Vec3 corner[3] = {vec(q[0]), vec(q[1]), vec(q[2])},
                   dot[3] = {vec(q_dot[0]), vec(q_dot[1]), vec(q_dot[2])};
        return array(face_map_jvp(c, corner, dot));
    });
    p.def("barycentrics_jvp", [](A33 m, A2 n, A33 m_dot, A2 n_dot) {
        Barycentrics b;
        barycentrics(map(m), vec(n), b);
        const Barycentrics dot = barycentrics_jvp(map(m), vec(n), b, map(m_dot), vec(n_dot));
        return A2{dot.u, dot.v};
    });
    p.def("cross", [](A3 a, A3 b) { return array(cross(vec(a), vec(b))); });
    p.def("cross_vjp", [](A3 a, A3 b, A3 bar) {
        Vec3 a_bar, b_bar;
        cross_vjp(vec(a), vec(b), vec(bar), a_bar, b_bar);
        return std::tuple(array(a_bar), array(b_bar));
    });
    p.def("dot", [](A3 a, A3 b) { return dot(vec(a), vec(b)); });
    p.def("dot_vjp", [](A3 a, A3 b, double bar) {
        Vec3 a_bar, b_bar;
        dot_vjp(vec(a), vec(b), bar, a_bar, b_bar);
        return std::tuple(array(a_bar), array(b_bar));
    });
    // Returns the columns of a FaceMap.
    p.def("face_map", [](const Camera& c, A33 q) {
        const Vec3 corner[3] = {vec(q[0]), vec(q[1]), vec(q[2])};
        return array(face_map(c, corner));
    });
    p.def("face_map_vjp", [](const Camera& c, A33 q, A33 bar) {
        const Vec3 corner[3] = {vec(q[0]), vec(q[1]), vec(q[2])};
        Vec3 q_bar[3];
        face_map_vjp(c, corner, map(bar), q_bar);
        return A33{array(q_bar[0]), array(q_bar[1]), array(q_bar[2])};
    });
    p.def("barycentrics", [](A33 m, A2 n) {
        Barycentrics b;
        const bool met = barycentrics(map(m), vec(n), b);
        return std::tuple(met, A2{b.u, b.v});
    });
    p.def("barycentrics_vjp", [](A33 m, A2 n, A2 bar) {
        Barycentrics b;
        barycentrics(map(m), vec(n), b);
        FaceMap m_bar;
        Vec2 n_bar;
        barycentrics_vjp(map(m), vec(n), b, {bar[0], bar[1]}, m_bar, n_bar);
        return std::tuple(array(m_bar), array(n_bar));
    });
    p.def("inside", [](double u, double v) {
        const Barycentrics b = inside({u, v});
        return A2{b.u, b.v};
    });

    using Texels = nb::ndarray<const double, nb::numpy, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
    p.def("texture_eval", [](Texels texels, A2 uv) {
        const Texture<double> t{{0, int64_t(texels.shape(0)), int64_t(texels.shape(1))}, texels.data()};
        std::vector<double> out(texels.shape(2));
        eval<0>(t, footprint(t, vec(uv)), int(texels.shape(2)), out.data());
        return out;
    });
    p.def("texture_eval_vjp", [](Texels texels, A2 uv, std::vector<double> bar) {
        const Texture<double> t{{0, int64_t(texels.shape(0)), int64_t(texels.shape(1))}, texels.data()};
        const Footprint f = footprint(t, vec(uv));
        std::array<int64_t, 4> texel;
        std::array<double, 4> weight;
        for (int i = 0; i < 4; ++i) texel[i] = f.texel[i], weight[i] = f.weight(i);
        return std::tuple(array(eval_vjp<0>(t, f, int(texels.shape(2)), bar.data())), texel, weight);
    });

    p.def("filter_radius", [](const std::string& name) { return Filter(kind(name)).radius(); });
    p.def("filter_weight", [](const std::string& name, double d) { return Filter(kind(name)).weight(d); });
    p.def("filter_sample", [](const std::string& name, double u) { return Filter(kind(name)).sample(u); });
    p.def("lattice", [](uint64_t random, int n) {
        const ShiftedLattice lattice(n);
        std::vector<double> x(n), y(n);
        lattice.fill(mix(random), 0, 1, x.data(), y.data());
        lattice.fill(mix(random), 1, n - 1, x.data() + 1, y.data() + 1);
        std::vector<A2> points;
        for (int i = 0; i < n; ++i) points.push_back({x[i], y[i]});
        return points;
    });
    p.def("sequence", [](uint64_t random, int n) {
        const ShiftedSequence sequence(mix(random));
        std::vector<A2> points;
        for (int i = 0; i < n; ++i) points.push_back(array(sequence(i)));
        return points;
    });
    p.def(
        "sobol",
        [](uint64_t random, int n, uint64_t first) {
            std::vector<double> x(n), y(n);
            ScrambledSobol(mix(random)).fill(first, n, x.data(), y.data());
            std::vector<A2> points;
            for (int i = 0; i < n; ++i) points.push_back({x[i], y[i]});
            return points;
        },
        "random"_a, "n"_a, "first"_a = 0);
    p.def("z_order", &z_order);
    p.def("systematic", [](std::vector<double> measure, int64_t n, double shift) {
        ThreadTeam team(1);
        Array<double> ends(measure.size());
        std::copy(measure.begin(), measure.end(), ends.begin());
        Systematic systematic(ends, team);
        systematic.draw(n, shift);
        std::vector<std::tuple<int64_t, double>> out;  // primitive and weight
        for (int64_t i = 0; i < n; ++i) {
            const int64_t k = systematic.primitive(systematic.position(i));
            out.emplace_back(k, systematic.weight(k));
        }
        return out;
    });
    using Image = nb::ndarray<const double, nb::numpy, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
    p.def("importance", [](Image adjoint, double radius, A2 low, A2 high) {
        ThreadTeam team(2);
        const Importance importance(adjoint.data(), int(adjoint.shape(1)), int(adjoint.shape(0)), int(adjoint.shape(2)),
                                    radius, team);
        return importance.mean(vec(low), vec(high));
    });

    using Verts = nb::ndarray<const double, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
    using Faces = nb::ndarray<const int32_t, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
    // Returns the faces of each edge, as (face, corner, backwards); the vertices from first[i] on have spacing[i].
    p.def("edges", [](Verts verts, Faces faces, std::vector<int32_t> first, std::vector<double> spacing) {
        ThreadTeam team(1);
        Topology topology(faces.data(), faces.shape(0), verts.shape(0), team);
        topology.weld(verts.data(), {first, spacing}, team);
        std::vector<std::vector<std::tuple<int, int, bool>>> out(topology.n_edges());
        for (int64_t e = 0; e < topology.n_edges(); ++e)
            for (const HalfEdge& h : topology.half_edges(e)) out[e].emplace_back(h.face, h.corner, h.backwards);
        return out;
    });
    // Returns intersections as (face, face, end, end, weight), and whether they are drawn with the probabilities
    // `shares` (F,). `windings` defines the surface's continuation: the same faces, possibly with reversed orientation.
    p.def("intersections", [](Verts verts, Faces faces, Faces windings, double spacing, In<float, 1> shares,
                              uint64_t seed, int threads) {
        ThreadTeam team(threads);
        FaceOrder order;
        const Spacing all{{0}, {spacing}};
        Topology topology(windings.data(), faces.shape(0), verts.shape(0), team);
        topology.weld(verts.data(), all, team);
        const PlacedFaces placed{faces.data(), int64_t(faces.shape(0)), verts.data(), all, topology};
        const Intersections found(placed, order, team);
        Array<float> share(shares.shape(0));
        std::copy_n(shares.data(), shares.shape(0), share.begin());
        const Array<Intersection> drawn =
            found.are_drawn() ? found.drawn(placed, share, seed, team) : Array<Intersection>(0);
        std::vector<std::tuple<int, int, A3, A3, double>> out;
        for (const Intersection& i : found.are_drawn() ? drawn : found.all())
            out.emplace_back(i.face[0], i.face[1], A3{i.a.x, i.a.y, i.a.z}, A3{i.b.x, i.b.y, i.b.z}, i.weight);
        return std::tuple(out, found.are_drawn());
    });
}

}  // namespace edgegrad
