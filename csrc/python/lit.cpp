// Binds the shading of lit scenes: values, cotangents and tangents at points, images, and the light on flat faces.

#include "shading/lit/lit.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <vector>

#include "accumulate/records.h"
#include "forward/lit_image.h"
#include "python/arrays.h"
#include "python/lit_arrays.h"
#include "python/shaped.h"
#include "python/unlocked.h"
#include "shading/lit/flat_light.h"
#include "shading/lit/indirect.h"
#include "shading/lit/light_tracing.h"

using namespace nanobind::literals;

namespace edgegrad {

void bind_lit_arrays(nb::module_& m);  // lit_arrays.cpp defines it.

namespace {

template <class T>
nb::tuple shade_points(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& points,
                       const LitOptions& options, bool values, int threads) {
    check_faces(arrays, lit);
    const LitPoints view = points.view(lit.scene, int64_t(arrays.faces.shape(0)));
    const size_t lights = light_samples(lit.scene, options).size();
    Array<double> radiance(0);
    std::vector<int8_t> seen(size_t(view.size) * lights);
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        radiance = zeros(view.size * lit.scene.channels, team);
        shade(lit.scene, arrays.view(), geometry->caster(), view, options, values ? radiance.data() : nullptr,
              seen.data(), team);
    });
    const size_t n = size_t(view.size);
    return nb::make_tuple(shaped(std::move(radiance), {n, size_t(lit.scene.channels)}),
                          shaped(std::move(seen), {n, lights}));
}

// Returns (F, 3, L); see flat_light.h. The lights have positions (L, 3) and powers.
nb::object light_on_faces(In<double, 2> verts, Rows faces, In<double, 1> eye, bool perspective, In<double, 2> place,
                          const std::vector<bool>& infinite, const std::vector<double>& power, int threads) {
    const size_t L = infinite.size(), V = verts.shape(0), F = faces.shape(0);
    if (verts.shape(1) != 3 || faces.shape(1) != 3 || eye.size() != 3) refuse("verts, faces, eye: expected 3 columns");
    if (place.shape(0) != L || place.shape(1) != 3 || power.size() != L)
        refuse("place, power: expected a row for each light");
    check_indices("faces", faces.data(), faces.size(), V, "verts", threads);
    std::vector<PunctualLight> lights;
    for (size_t l = 0; l < L; ++l) lights.push_back({{place(l, 0), place(l, 1), place(l, 2)}, infinite[l], power[l]});
    Array<double> found(0);
    unlocked(threads, [&](ThreadTeam& team) {
        found = light_on_flat_faces(
            {verts.data(), faces.data(), int64_t(V), int64_t(F), {eye(0), eye(1), eye(2)}, perspective}, lights, team);
    });
    return shaped(std::move(found), {F, 3, L});
}

// Returns the image without what lies behind the surfaces, (H · W, C), and which lights' shadows were requested.
template <class T>
nb::tuple lit_image(const SceneArrays<T>& arrays, const LitArrays& lit, const Camera& camera, const ImageOptions& image,
                    const LitOptions& options, int points, uint64_t seed, uint64_t again, int threads,
                    const HitArrays<T>& hits) {
    check_faces(arrays, lit), hits.check(arrays, camera);
    if (points < 1) refuse("points: expected at least 1");
    LitImage<T> found{Array<T>(0), {}};
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        found = render_lit(lit.scene, arrays.view(), camera, geometry->caster(), image, options,
                           LitSampling{points, seed, again}, team, hits.view());
    });
    const size_t channels = size_t(lit.scene.channels), pixels = size_t(found.radiance.size()) / channels;
    const size_t lights = found.shadow_needed.size();
    return nb::make_tuple(shaped(std::move(found.radiance), {pixels, channels}),
                          shaped(std::move(found.shadow_needed), {lights, 1}));
}

void check_seen(const LitArrays& lit, const LitPoints& points, const LitOptions& options, const In<int8_t, 2>& seen) {
    if (int64_t(seen.shape(0)) != points.size || seen.shape(1) != light_samples(lit.scene, options).size())
        refuse("seen: expected what shade() found");
}
int64_t faces_of(const LitArrays& lit) { return lit.scene.meshes.back().first_face + lit.scene.meshes.back().faces; }

// Holds the cotangent of a table, in its type. Large float tables are summed in float, because few samples go to each
// row. Fetching memory for the doubles of a texture would then take longer than the additions.
class Cotangent {
   public:
    Cotangent(const Table& table, bool wanted, ThreadTeam& team) : table_(table) {
        if (!wanted) return;
        const int64_t n = table.rows * table.width;
        if (table.wide || n < least_summed_in_float) wide_ = zeros(n, team);
        else narrow_ = zeros<float>(n, team);
    }
    TableBar bar() { return {wide_.empty() ? nullptr : wide_.data(), narrow_.empty() ? nullptr : narrow_.data()}; }
    void finish(ThreadTeam& team) {
        if (!table_.wide && !wide_.empty()) narrow_ = to_float(wide_, team);
    }
    nb::object take() {
        const std::vector<size_t> shape{size_t(table_.rows), size_t(table_.width)};
        return table_.wide ? shaped(std::move(wide_), shape) : shaped(std::move(narrow_), shape);
    }

   private:
    static constexpr int64_t least_summed_in_float = 1 << 16;
    const Table& table_;
    Array<double> wide_{0};
    Array<float> narrow_{0};
};

// Returns the cotangents of the tables (None where not wanted), of b, and of its spread, if known. compute(to, places,
// team) adds and writes them.
template <class Compute>
nb::tuple cotangents(const LitArrays& lit, const LitPoints& points, const In<double, 2>& bar,
                     const std::vector<bool>& wanted, int threads, Compute compute) {
    if (int64_t(bar.shape(0)) != points.size || int(bar.shape(1)) != lit.scene.channels)
        refuse("bar: expected a row a point");
    if (wanted.size() != lit.scene.tables.size()) refuse("wanted: expected a number for each table");
    std::vector<Cotangent> found;
    Array<double> b_bar(3 * points.size), spread_bar(points.spread ? spread_size * points.size : 0);
    unlocked(threads, [&](ThreadTeam& team) {
        std::vector<TableBar> to;
        for (size_t i = 0; i < wanted.size(); ++i) {
            found.emplace_back(lit.scene.tables[i], wanted[i], team);
            to.push_back(found[i].bar());
        }
        compute(to, {b_bar.data(), points.spread ? spread_bar.data() : nullptr}, team);
        for (Cotangent& cotangent : found) cotangent.finish(team);
    });
    nb::list out;
    for (size_t i = 0; i < found.size(); ++i) out.append(wanted[i] ? found[i].take() : nb::none());
    const size_t n = size_t(points.size);
    return nb::make_tuple(out, shaped(std::move(b_bar), {n, 3}),
                          points.spread ? shaped(std::move(spread_bar), {n, 2, 2}) : nb::none());
}

nb::tuple shade_points_vjp(const LitArrays& lit, const PointArrays& points, const LitOptions& options,
                           In<int8_t, 2> seen, In<double, 2> bar, const std::vector<bool>& wanted, int threads) {
    const LitPoints view = points.view(lit.scene, faces_of(lit));
    check_seen(lit, view, options, seen);
    return cotangents(lit, view, bar, wanted, threads,
                      [&](const auto& to, LitPositions<double> places, ThreadTeam& team) {
                          shade_vjp(lit.scene, view, options, seen.data(), bar.data(), to, places, team);
                      });
}

// Does the same for functions that cast rays in the scene: compute(geometry's caster, points, to, places, team).
template <class T, class Compute>
nb::tuple traced_cotangents(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& points,
                            const In<double, 2>& bar, const std::vector<bool>& wanted, int threads, Compute compute) {
    check_faces(arrays, lit);
    const LitPoints view = points.view(lit.scene, faces_of(lit));
    return cotangents(lit, view, bar, wanted, threads,
                      [&](const auto& to, LitPositions<double> places, ThreadTeam& team) {
                          GeometryWork work;
                          const auto geometry = arrays.geometry({}, team, work);
                          compute(geometry->caster(), view, to, places, team);
                      });
}

template <class T>
nb::tuple trace_and_shade_points_vjp(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& points,
                                     const LitOptions& options, In<double, 2> bar, const std::vector<bool>& wanted,
                                     int threads) {
    return traced_cotangents(
        arrays, lit, points, bar, wanted, threads,
        [&](const auto& caster, const LitPoints& view, const auto& to, auto places, ThreadTeam& team) {
            trace_and_shade_vjp(lit.scene, arrays.view(), caster, view, options, bar.data(), to, places, team);
        });
}

// Reads the tangents of the tables, of b and of its spread; None: zero.
using Tangents2 = std::optional<In<double, 2>>;
using Tangents3 = std::optional<In<double, 3>>;
LitScene with_tangents(const LitScene& scene, const std::vector<Tangents2>& tangents) {
    LitScene moving = scene;
    if (tangents.size() != moving.tables.size()) refuse("tangents: expected one for each table, or None");
    for (size_t i = 0; i < tangents.size(); ++i) {
        if (!tangents[i]) continue;
        if (int64_t(tangents[i]->shape(0)) != moving.tables[i].rows ||
            int(tangents[i]->shape(1)) != moving.tables[i].width)
            refuse("tangents: expected the shape of the table");
        moving.tables[i].tangent = tangents[i]->data();
    }
    return moving;
}
LitPositions<const double> tangents_of_places(const LitPoints& points, const Tangents2& b_dot,
                                              const Tangents3& spread_dot) {
    if (b_dot && (int64_t(b_dot->shape(0)) != points.size || b_dot->shape(1) != 3))
        refuse("b_dot: expected a row a point");
    if (spread_dot && (!points.spread || int64_t(spread_dot->shape(0)) != points.size || spread_dot->shape(1) != 2 ||
                       spread_dot->shape(2) != 2))
        refuse("spread_dot: expected the shape of spread");
    return {b_dot ? b_dot->data() : nullptr, spread_dot ? spread_dot->data() : nullptr};
}

nb::object shade_points_jvp(const LitArrays& lit, const PointArrays& points, const LitOptions& options,
                            In<int8_t, 2> seen, const std::vector<Tangents2>& tangents, Tangents2 b_dot,
                            Tangents3 spread_dot, int threads) {
    const LitPoints view = points.view(lit.scene, faces_of(lit));
    check_seen(lit, view, options, seen);
    const LitScene moving = with_tangents(lit.scene, tangents);
    const LitPositions<const double> dot = tangents_of_places(view, b_dot, spread_dot);
    std::vector<double> out(size_t(view.size) * size_t(moving.channels));
    unlocked(threads, [&](ThreadTeam& team) { shade_jvp(moving, view, options, seen.data(), dot, out.data(), team); });
    return shaped(std::move(out), {size_t(view.size), size_t(moving.channels)});
}

// Returns the indirect light at points, (N, C).
template <class T>
nb::object indirect_points(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& points,
                           const LitOptions& options, int threads) {
    check_faces(arrays, lit);
    const LitPoints view = points.view(lit.scene, faces_of(lit));
    std::vector<double> out(size_t(view.size) * size_t(lit.scene.channels));
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        indirect(lit.scene, arrays.view(), geometry->caster(), view, options, out.data(), team);
    });
    return shaped(std::move(out), {size_t(view.size), size_t(lit.scene.channels)});
}

template <class T>
nb::tuple indirect_points_vjp(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& points,
                              const LitOptions& options, In<double, 2> bar, const std::vector<bool>& wanted,
                              int threads) {
    return traced_cotangents(
        arrays, lit, points, bar, wanted, threads,
        [&](const auto& caster, const LitPoints& view, const auto& to, auto places, ThreadTeam& team) {
            indirect_vjp(lit.scene, arrays.view(), caster, view, options, bar.data(), to, places, team);
        });
}

template <class T>
nb::object indirect_points_jvp(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& points,
                               const LitOptions& options, const std::vector<Tangents2>& tangents, Tangents2 b_dot,
                               Tangents3 spread_dot, int threads) {
    check_faces(arrays, lit);
    const LitPoints view = points.view(lit.scene, faces_of(lit));
    const LitScene moving = with_tangents(lit.scene, tangents);
    const LitPositions<const double> dot = tangents_of_places(view, b_dot, spread_dot);
    std::vector<double> out(size_t(view.size) * size_t(moving.channels));
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        indirect_jvp(moving, arrays.view(), geometry->caster(), view, options, dot, out.data(), team);
    });
    return shaped(std::move(out), {size_t(view.size), size_t(moving.channels)});
}

// Returns how light at points reaches the image after `first`, …, `last` further steps. The arrays are the point (M,),
// the image position (M, 2), and the radiance times px² (M, C).
template <class T>
nb::tuple points_towards_camera(const SceneArrays<T>& arrays, const LitArrays& lit, const Camera& camera,
                                const ImageOptions& image, In<int64_t, 1> face, In<double, 2> b, In<int64_t, 1> seed,
                                In<double, 2> origin, In<double, 2> carried, int first, int last, int threads) {
    check_faces(arrays, lit);
    const size_t n = face.size(), C = size_t(lit.scene.channels);
    if (b.shape(0) != n || b.shape(1) != 3 || seed.size() != n || origin.shape(0) != n || origin.shape(1) != 3 ||
        carried.shape(0) != n || carried.shape(1) != C)
        refuse("b, seed, origin, carried: expected a row for each point");
    if (first < 0 || last < first || last > most_bounces) refuse("steps: expected some in ascending order");
    for (size_t i = 0; i < n; ++i)
        if (face(i) < 0 || face(i) >= faces_of(lit)) refuse("face: expected faces of the scene");
    const Arrivals arrivals{int64_t(n), face.data(), b.data(), origin.data(), carried.data(), seed.data()};
    Array<int64_t> arrival(0);
    Array<double> x(0), radiance(0);
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        const CameraConnections connections(camera, image.filter.radius() - 0.5);
        const std::vector<Connections> found = towards_camera(lit.scene, arrays.view(), geometry->caster(), connections,
                                                              arrivals, StepRange{first, last}, team);
        arrival = joined(found, &Connections::arrival, team), x = joined(found, &Connections::x, team);
        radiance = joined(found, &Connections::radiance, team);
    });
    const size_t m = size_t(arrival.size());
    return nb::make_tuple(shaped(std::move(arrival), {m}), shaped(std::move(x), {m, 2}),
                          shaped(std::move(radiance), {m, C}));
}

// Returns index, uv and pdf, (N, samples) of each.
nb::tuple drawn_light_points(const LitArrays& lit, const PointArrays& points, const LitOptions& options, int light,
                             int threads) {
    const LitPoints view = points.view(lit.scene, faces_of(lit));
    if (light < 0 || size_t(light) >= lit.scene.lights.size() || options.samples < 1)
        refuse("light: expected one of the scene");
    const size_t n = size_t(view.size), k = size_t(options.samples);
    std::vector<LightPoint> found(n * k);
    unlocked(threads,
             [&](ThreadTeam& team) { draw_light_points(lit.scene, view, options, light, found.data(), team); });
    std::vector<int64_t> index;
    std::vector<double> uv, pdf;
    for (const LightPoint& p : found) index.push_back(p.index), uv.insert(uv.end(), {p.u, p.v}), pdf.push_back(p.pdf);
    return nb::make_tuple(shaped(std::move(index), {n, k}), shaped(std::move(uv), {n, k, 2}),
                          shaped(std::move(pdf), {n, k}));
}

}  // namespace

template <class T>
void bind_scene_lit(nb::class_<SceneArrays<T>>& scene) {
    scene.def("shade", &shade_points<T>, "lit"_a, "points"_a, "options"_a, "values"_a, "threads"_a)
        .def("trace_and_shade_vjp", &trace_and_shade_points_vjp<T>, "lit"_a, "points"_a, nb::kw_only(), "options"_a,
             "bar"_a.noconvert(), "wanted"_a, "threads"_a)
        .def("indirect", &indirect_points<T>, "lit"_a, "points"_a, "options"_a, "threads"_a)
        .def("indirect_vjp", &indirect_points_vjp<T>, "lit"_a, "points"_a, nb::kw_only(), "options"_a,
             "bar"_a.noconvert(), "wanted"_a, "threads"_a)
        .def("indirect_jvp", &indirect_points_jvp<T>, "lit"_a, "points"_a, nb::kw_only(), "options"_a, "tangents"_a,
             "b_dot"_a.none(), "spread_dot"_a.none(), "threads"_a)
        .def("towards_camera", &points_towards_camera<T>, "lit"_a, nb::kw_only(), "camera"_a, "image"_a, "face"_a,
             "b"_a, "seed"_a, "origin"_a, "carried"_a, "first"_a, "last"_a, "threads"_a)
        .def("lit_image", &lit_image<T>, "lit"_a, "camera"_a, "image"_a, "options"_a, "points"_a, "seed"_a, "again"_a,
             "threads"_a, "hits"_a);
}
template void bind_scene_lit(nb::class_<SceneArrays<float>>&);
template void bind_scene_lit(nb::class_<SceneArrays<double>>&);

void bind_lit(nb::module_& m) {
    bind_lit_arrays(m);
    m.def("shade_vjp", &shade_points_vjp, "lit"_a, "points"_a, nb::kw_only(), "options"_a, "seen"_a.noconvert(),
          "bar"_a.noconvert(), "wanted"_a, "threads"_a);
    m.def("light_points", &drawn_light_points, "lit"_a, "points"_a, "options"_a, "light"_a, "threads"_a);
    m.def("light_on_faces", &light_on_faces, "verts"_a.noconvert(), "faces"_a.noconvert(), "eye"_a.noconvert(),
          "perspective"_a, "place"_a.noconvert(), "infinite"_a, "power"_a, "threads"_a);
    m.def("shade_jvp", &shade_points_jvp, "lit"_a, "points"_a, nb::kw_only(), "options"_a, "seen"_a.noconvert(),
          "tangents"_a, "b_dot"_a.none(), "spread_dot"_a.none(), "threads"_a);
}

}  // namespace edgegrad
