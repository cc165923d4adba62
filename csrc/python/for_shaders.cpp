// What shaders written in PyTorch are made of: samples as records of arrays, what is seen at places and along rays.

#include <nanobind/stl/optional.h>

#include <optional>

#include "backward/backward.h"
#include "boundary/shadows.h"
#include "forward/pixel_hits.h"
#include "forward/places.h"
#include "forward/trace.h"
#include "python/arrays.h"
#include "python/unlocked.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

// A vector or an Array as an array of rows of this shape, without a copy.
template <class Values>
nb::object rows(Values&& values, std::vector<size_t> row = {}) {
    static_assert(!std::is_reference_v<Values>);  // it is moved from
    using X = std::remove_pointer_t<decltype(values.data())>;
    size_t width = 1;
    for (const size_t n : row) width *= n;
    auto* kept = new Values(std::move(values));
    const nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<Values*>(p); });
    row.insert(row.begin(), size_t(kept->size()) / width);
    return nb::cast(nb::ndarray<nb::numpy, X>(kept->data(), row.size(), row.data(), owner));
}

template <class T>
nb::dict pixel_hits(const SceneArrays<T>& arrays, const Camera& camera, const ImageOptions& options, int threads,
                    int first, int end, int most, std::optional<In<uint8_t, 2>> only, const HitArrays<T>& hits) {
    hits.check(arrays, camera);
    if (first < 0 || first > end || end > camera.height) refuse("rows: expected rows of the image");
    if (most < 1) refuse("most: expected at least 1");
    if (only && (int(only->shape(0)) != camera.height || int(only->shape(1)) != camera.width))
        refuse("only: expected a number a pixel");
    const PixelChoice choice{first, end, most, only ? only->data() : nullptr};
    PixelHits found(0);
    unlocked(threads, [&](Team& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        found = find_pixel_hits(arrays.view(), camera, geometry->caster(), options, choice, team, hits.view());
    });
    nb::dict out;
    out["pixel"] = rows(std::move(found.pixel)), out["face"] = rows(std::move(found.face));
    out["b"] = rows(std::move(found.b), {2}), out["x"] = rows(std::move(found.x), {2});
    out["weight"] = rows(std::move(found.weight));
    return out;
}

nb::dict arrays_of(CurveRecords&& c) {
    nb::dict curves;
    curves["x"] = rows(std::move(c.x), {2}), curves["face"] = rows(std::move(c.face), {CurveRecords::surfaces});
    curves["b"] = rows(std::move(c.b), {CurveRecords::surfaces, 2});
    curves["factor"] = rows(std::move(c.factor), {CurveRecords::surfaces});
    curves["by_k"] = rows(std::move(c.by_k), {intrinsics_width});
    curves["row_of"] = rows(std::move(c.row_of)), curves["vertex"] = rows(std::move(c.vertex));
    curves["by_q"] = rows(std::move(c.by_q), {3});
    curves["uv_row_of"] = rows(std::move(c.uv_row_of)), curves["uv"] = rows(std::move(c.uv));
    curves["by_uv"] = rows(std::move(c.by_uv), {2});
    curves["alpha_row_of"] = rows(std::move(c.alpha_row_of)), curves["alpha"] = rows(std::move(c.alpha));
    curves["by_alpha"] = rows(std::move(c.by_alpha));
    curves["light"] = rows(std::move(c.light)), curves["light_uv"] = rows(std::move(c.light_uv), {2});
    curves["by_light"] = rows(std::move(c.by_light), {3});
    return curves;
}

// The samples of the terms inside faces and on curves, as records of arrays.
template <class T>
nb::tuple samples(const SceneArrays<T>& arrays, const Camera& camera, const ImageOptions& image,
                  const GradientOptions& options, int threads, Out<T, 3> adjoint, const HitArrays<T>& hits) {
    check_image("adjoint", adjoint, camera, arrays.background.shape(2));
    hits.check(arrays, camera);
    const SceneView<T> scene = arrays.view();
    Records found;
    with_geometry(arrays, options.boundary, threads, [&](const Geometry& geometry, Team& team) {
        found = record_samples(BackwardInput<T>{scene, camera, geometry, image, adjoint.data(), hits.view()}, options,
                               team);
    });
    SurfaceRecords& s = found.surface;
    nb::dict surface;
    surface["face"] = rows(std::move(s.face)), surface["x"] = rows(std::move(s.x), {2});
    surface["along"] = rows(std::move(s.along), {3}), surface["weight"] = rows(std::move(s.weight));
    surface["along_by_k"] = rows(std::move(s.along_by_k), {3, intrinsics_width});
    return nb::make_tuple(surface, arrays_of(std::move(found.curves)));
}

// A light as edges cast shadows of it.
struct LightArrays {
    In<double, 3> corner;
    In<double, 1> chance;
    In<int32_t, 1> face;
    bool infinite, extended, two_sided;

    void check(int64_t faces) const {
        const size_t n = corner.shape(0);
        if (corner.shape(1) != 3 || corner.shape(2) != 3 || chance.size() != n || face.size() != n)
            refuse("light: expected three corners, a chance and a face for each part");
        if (n == 0) refuse("light: expected a part at least");
        check_finite("corner", corner.data(), n, 9, 1), check_finite("chance", chance.data(), n, 1, 1);
        for (size_t i = 0; i < n; ++i) {
            if (!(chance(i) > 0)) refuse("chance: expected numbers above zero");
            if (face(i) >= faces) refuse("face: expected a face of the scene, or -1");
        }
    }
    LightParts view() const {
        return {corner.data(), chance.data(), face.data(), int64_t(chance.size()), infinite, extended, two_sided};
    }
};

// The samples on the borders of shadows.
template <class T>
nb::dict shadow_samples(const SceneArrays<T>& arrays, const Camera& camera, const ImageOptions& image,
                        const GradientOptions& options, const LightArrays& light, int64_t samples, int threads,
                        Out<T, 3> adjoint, const HitArrays<T>& hits) {
    check_image("adjoint", adjoint, camera, arrays.background.shape(2));
    hits.check(arrays, camera), light.check(int64_t(arrays.faces.shape(0)));
    const SceneView<T> scene = arrays.view();
    CurveRecords found;
    unlocked(threads, [&](Team& team) {
        GeometryWork done;
        const auto geometry = arrays.geometry({.topology = true, .parts = true}, team, done);
        found = record_shadows(BackwardInput<T>{scene, camera, *geometry, image, adjoint.data(), hits.view()}, options,
                               light.view(), samples, team);
    });
    return arrays_of(std::move(found));
}

// The pixels whose filter reaches points of the image: for each pair the point, the pixel, and the filter's weight
// there.
nb::tuple footprints(In<double, 2> x, const std::string& filter, int width, int height) {
    if (x.shape(1) != 2) refuse("x: expected rows of two numbers");
    const FilteredPixels pixels(make_filter(filter), width, height);
    std::vector<int64_t> point, pixel;
    std::vector<double> weight;
    for (size_t i = 0; i < x.shape(0); ++i)
        pixels.around({x(i, 0), x(i, 1)}, [&](int64_t p, double w) {
            point.push_back(int64_t(i)), pixel.push_back(p), weight.push_back(w);
        });
    return nb::make_tuple(rows(std::move(point)), rows(std::move(pixel)), rows(std::move(weight)));
}

Places places_of(const In<double, 2>& x) {
    if (x.shape(1) != 2) refuse("x: expected rows of two numbers");
    return {x.data(), int64_t(x.shape(0))};
}

template <class T>
nb::dict seen_at(const SceneArrays<T>& arrays, const Camera& camera, In<double, 2> x, int threads) {
    PlaceHits found;
    const Places places = places_of(x);
    unlocked(threads, [&](Team& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({.parts = true}, team, work);
        found = hits_at(arrays.view(), camera, *geometry, places, team);
    });
    nb::dict out;
    out["face"] = rows(std::move(found.face)), out["part"] = rows(std::move(found.part));
    out["b"] = rows(std::move(found.b), {2});
    return out;
}

nb::dict rays_of(const Camera& camera, In<double, 2> x, int threads) {
    RayRecords found;
    const Places places = places_of(x);
    unlocked(threads, [&](Team& team) { found = rays_at(camera, places, team); });
    nb::dict out;
    out["along"] = rows(std::move(found.along), {3}), out["along_by_x"] = rows(std::move(found.along_by_x), {3, 2});
    out["along_by_k"] = rows(std::move(found.along_by_k), {3, intrinsics_width});
    return out;
}

void check_rows(const char* name, const In<double, 2>& array, size_t n) {
    if (array.shape(0) != n || array.shape(1) != 3) refuse(std::string(name) + ": expected three numbers a ray");
}

template <class T>
nb::dict trace_rays(const SceneArrays<T>& arrays, In<double, 2> origins, In<double, 2> directions,
                    std::optional<In<int32_t, 1>> ignored, int threads) {
    const size_t n = origins.shape(0);
    if (ignored && ignored->size() != n) refuse("ignored: expected a number a ray");
    check_rows("origins", origins, n), check_rows("directions", directions, n);
    RayHits found;
    unlocked(threads, [&](Team& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        found = trace(arrays.view(), geometry->caster(),
                      {origins.data(), directions.data(), int64_t(n), ignored ? ignored->data() : nullptr}, team);
    });
    nb::dict out;
    out["face"] = rows(std::move(found.face)), out["b"] = rows(std::move(found.b), {2});
    return out;
}

template <class T>
nb::object visible_points(const SceneArrays<T>& arrays, In<int32_t, 1> face, In<double, 2> b, In<double, 2> to,
                          In<double, 1> contact, int threads) {
    const size_t n = face.size();
    if (b.shape(0) != n || b.shape(1) != 2 || contact.size() != n) refuse("b, contact: expected a row a point");
    check_rows("to", to, n);
    check_indices("face", face.data(), n, arrays.faces.shape(0), "faces", threads);
    std::vector<uint8_t> found;
    unlocked(threads, [&](Team& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        found = visible(arrays.view(), geometry->caster(),
                        {face.data(), b.data(), to.data(), contact.data(), int64_t(n)}, team);
    });
    return rows(std::move(found));
}

}  // namespace

template <class T>
void bind_scene_for_shaders(nb::class_<SceneArrays<T>>& scene) {
    scene
        .def("pixel_hits", &pixel_hits<T>, "camera"_a, "options"_a, "threads"_a, "first"_a, "end"_a, "most"_a,
             "only"_a.none(), "hits"_a)
        .def("samples", &samples<T>, "camera"_a, "image"_a, "options"_a, "threads"_a, "adjoint"_a.noconvert(), "hits"_a)
        .def("shadow_samples", &shadow_samples<T>, "camera"_a, "image"_a, "options"_a, "light"_a, "samples"_a,
             "threads"_a, "adjoint"_a.noconvert(), "hits"_a)
        .def("hits_at", &seen_at<T>, "camera"_a, "x"_a.noconvert(), "threads"_a)
        .def("trace", &trace_rays<T>, "origins"_a.noconvert(), "directions"_a.noconvert(),
             "ignored"_a.noconvert().none(), "threads"_a)
        .def("visible", &visible_points<T>, "face"_a.noconvert(), "b"_a.noconvert(), "to"_a.noconvert(),
             "contact"_a.noconvert(), "threads"_a);
}

template void bind_scene_for_shaders(nb::class_<SceneArrays<float>>&);
template void bind_scene_for_shaders(nb::class_<SceneArrays<double>>&);

void bind_for_shaders(nb::module_& m) {
    nb::class_<LightArrays>(m, "LightParts")
        .def(nb::new_([](In<double, 3> corner, In<double, 1> chance, In<int32_t, 1> face, bool infinite, bool extended,
                         bool two_sided) { return LightArrays{corner, chance, face, infinite, extended, two_sided}; }),
             "corner"_a.noconvert(), "chance"_a.noconvert(), "face"_a.noconvert(), "infinite"_a, "extended"_a,
             "two_sided"_a);
    m.def("footprints", &footprints, "x"_a.noconvert(), "filter"_a, "width"_a, "height"_a);
    m.def("most_shadow_samples", &most_shadow_samples, "width"_a, "height"_a, "spp"_a);
    m.def("rays_at", &rays_of, "camera"_a, "x"_a.noconvert(), "threads"_a);
}

}  // namespace edgegrad
