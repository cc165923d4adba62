// Serves shaders written in PyTorch: records of samples, and what is seen at image points and along rays.

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "backward/backward.h"
#include "forward/image_points.h"
#include "forward/pixel_hits.h"
#include "python/arrays.h"
#include "python/curve_arrays.h"
#include "python/shaped.h"
#include "python/unlocked.h"
#include "rays/trace.h"
#include "secondary/indirect_shadows.h"
#include "secondary/shadows.h"
#include "texture/pyramid.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

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
    unlocked(threads, [&](ThreadTeam& team) {
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

// Returns the samples of the terms inside faces and on curves, as records of arrays.
template <class T>
nb::tuple samples(const SceneArrays<T>& arrays, const Camera& camera, const ImageOptions& image,
                  const GradientOptions& options, double least, int threads, const HitArrays<T>& hits,
                  const std::optional<In<uint8_t, 1>>& detailed, const std::optional<In<uint8_t, 1>>& transparent,
                  const std::optional<In<T, 2>>& importance) {
    hits.check(arrays, camera);
    if (importance) {
        if (int(importance->shape(0)) != camera.height || int(importance->shape(1)) != camera.width)
            refuse("importance: expected a number a pixel");
        if (!std::all_of(importance->data(), importance->data() + importance->size(),
                         [](T x) { return x > 0 && std::isfinite(x); }))
            refuse("importance: expected finite numbers above zero");
    }
    const SceneView<T> scene = arrays.view();
    RecordList found;
    with_geometry(arrays, options.boundary, threads, [&](const Geometry& geometry, ThreadTeam& team) {
        found = record_samples(BackwardInput<T>{scene, camera, geometry, image, nullptr, hits.view(),
                                                marked_faces("detailed", arrays, detailed),
                                                marked_faces("transparent", arrays, transparent),
                                                importance ? importance->data() : nullptr},
                               options, team);
    });
    nb::dict surface;
    const auto add = [&](const char* name, auto field, std::vector<size_t> row = {}) {
        surface[name] = rows(unlocked(threads, [&](ThreadTeam& team) { return joined(found.surface, field, team); }),
                             std::move(row));
    };
    using S = SurfaceRecords;
    add("face", &S::face), add("x", &S::x, {2}), add("along", &S::along, {3}), add("weight", &S::weight);
    add("along_by_k", &S::along_by_k, {3, intrinsics_width});
    return nb::make_tuple(surface, curve_arrays(found.curves, least, false, threads));
}

// Holds a light for which edges cast shadows.
struct ShadowLightArrays {
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

// Returns the samples on shadow boundaries of `casters`, the same faces as light sees them. `seen` limits them to
// surfaces that the camera sees; otherwise they lie on all surfaces.
template <class T>
nb::dict shadow_samples(const SceneArrays<T>& arrays, const SceneArrays<T>& casters, const Camera& camera,
                        const ImageOptions& image, const GradientOptions& options, const ShadowLightArrays& light,
                        int64_t samples, double least, bool one, bool seen, int threads, const HitArrays<T>& hits,
                        const std::optional<In<uint8_t, 1>>& transparent) {
    hits.check(arrays, camera), light.check(int64_t(arrays.faces.shape(0)));
    if (casters.faces.shape(0) != arrays.faces.shape(0)) refuse("casters: expected the faces of the scene");
    const SceneView<T> scene = arrays.view(), casting = casters.view();
    std::vector<CurveRecords> found;
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork done;
        const auto geometry = arrays.geometry({.topology = true, .parts = true}, team, done);
        const BackwardInput<T> input{scene,   camera,      *geometry, image,
                                     nullptr, hits.view(), nullptr,   marked_faces("transparent", arrays, transparent)};
        found = record_curves(input, options, seen, team, [&](const BackwardView<T>& view, GradientSink& to) {
            if (seen) add_shadows(view, casting, light.view(), samples, Record{options.intrinsics}, to);
            else add_indirect_shadows(view, casting, light.view(), samples, to);
        });
    });
    return curve_arrays(found, least, one, threads);
}

// Returns whether faces pass through each other anywhere.
template <class T>
bool has_intersections(const SceneArrays<T>& arrays, int threads) {
    bool found = false;
    with_geometry(arrays, true, threads, [&](const Geometry& geometry, ThreadTeam&) {
        const Intersections& all = geometry.intersections();
        found = all.are_drawn() || !all.all().empty();
    });
    return found;
}

ImagePoints image_points(const In<double, 2>& x) {
    if (x.shape(1) != 2) refuse("x: expected rows of two numbers");
    return {x.data(), int64_t(x.shape(0))};
}

// Returns Σ k(x − c) · value over points x (S, 2) with values (S, C), for pixels with centres c: (H · W, C).
nb::object splat(In<double, 2> x, In<double, 2> values, const std::string& filter, int width, int height) {
    const size_t n = image_points(x).size, C = values.shape(1);
    if (values.shape(0) != n) refuse("values: expected a row for each point");
    const FilteredPixels pixels(make_filter(filter), width, height);
    std::vector<double> out(size_t(width) * size_t(height) * C, 0.0);
    for (size_t i = 0; i < n; ++i)
        pixels.around({x(i, 0), x(i, 1)}, [&](int64_t p, double w) {
            for (size_t c = 0; c < C; ++c) out[size_t(p) * C + c] += w * values(i, c);
        });
    return rows(std::move(out), {C});
}

// Returns the adjoint, (S, C): Σ k(x − c) · image over the pixels (H · W, C), for points x, times their optional
// weights (S,).
template <class T>
nb::object splat_vjp(In<double, 2> x, In<T, 2> image, const std::string& filter, int width, int height, int threads,
                     const std::optional<In<double, 1>>& weight) {
    const ImagePoints points = image_points(x);
    const size_t C = image.shape(1);
    if (image.shape(0) != size_t(width) * size_t(height)) refuse("image: expected a row for each pixel");
    if (weight && int64_t(weight->size()) != points.size) refuse("weight: expected a number for each point");
    const FilteredPixels pixels(make_filter(filter), width, height);
    Array<T> out(points.size * int64_t(C));
    unlocked(threads, [&](ThreadTeam& team) {
        team.parallel_for_blocks(points.size, [&](int64_t, int64_t first, int64_t last) {
            std::vector<double> sum(C);
            for (int64_t i = first; i < last; ++i) {
                std::fill(sum.begin(), sum.end(), 0.0);
                pixels.around(points[i], [&](int64_t p, double w) {
                    for (size_t c = 0; c < C; ++c) sum[c] += w * double(image.data()[size_t(p) * C + c]);
                });
                for (size_t c = 0; c < C; ++c)
                    out[i * int64_t(C) + int64_t(c)] = T((weight ? (*weight)(size_t(i)) : 1) * sum[c]);
            }
        });
    });
    return shaped(std::move(out), {size_t(points.size), C});
}

template <class T>
nb::dict seen_at(const SceneArrays<T>& arrays, const Camera& camera, In<double, 2> x, int threads) {
    ImagePointHits found;
    const ImagePoints points = image_points(x);
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({.parts = true}, team, work);
        found = hits_at(arrays.view(), camera, *geometry, points, team);
    });
    nb::dict out;
    out["face"] = rows(std::move(found.face)), out["part"] = rows(std::move(found.part));
    out["b"] = rows(std::move(found.b), {2});
    return out;
}

nb::dict rays_of(const Camera& camera, In<double, 2> x, bool intrinsics, int threads) {
    RayRecords found;
    const ImagePoints points = image_points(x);
    unlocked(threads, [&](ThreadTeam& team) { found = rays_at(camera, points, intrinsics, team); });
    nb::dict out;
    out["along"] = rows(std::move(found.along), {3}), out["along_by_x"] = rows(std::move(found.along_by_x), {3, 2});
    out["along_by_k"] = rows(std::move(found.along_by_k), {3, intrinsics_width});
    return out;
}

// Binds pyramids of images (h, w, K): (M, K), and the cotangents back.
template <class T>
void bind_pyramid(nb::module_& m) {
    const auto shape = [](int64_t height, int64_t width, int64_t channels) {
        if (height < 1 || width < 1 || channels < 1) refuse("image: expected texels");
        return PyramidShape{{0, height, width}, int(channels)};
    };
    m.def(
        "pyramid",
        [shape](In<T, 3> image, int threads) {
            const PyramidShape own = shape(image.shape(0), image.shape(1), image.shape(2));
            Array<T> found(0);
            unlocked(threads, [&](ThreadTeam& team) { found = pyramid(own, image.data(), team); });
            return rows(std::move(found), {image.shape(2)});
        },
        "image"_a.noconvert(), "threads"_a);
    m.def(
        "pyramid_vjp",
        [shape](In<T, 2> bar, size_t height, size_t width, int threads) {
            const PyramidShape own = shape(height, width, bar.shape(1));
            if (int64_t(bar.shape(0)) != own.texels()) refuse("bar: expected a row a texel of the pyramid");
            Array<T> found(0);
            unlocked(threads, [&](ThreadTeam& team) { found = pyramid_vjp(own, bar.data(), team); });
            return shaped(std::move(found), {height, width, bar.shape(1)});
        },
        "bar"_a.noconvert(), "height"_a, "width"_a, "threads"_a);
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
    unlocked(threads, [&](ThreadTeam& team) {
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
    unlocked(threads, [&](ThreadTeam& team) {
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
        .def("pixel_hits", &pixel_hits<T>, "camera"_a, "image"_a, "threads"_a, "first"_a, "end"_a, "most"_a,
             "only"_a.none(), "hits"_a)
        .def("samples", &samples<T>, "camera"_a, "image"_a, "options"_a, "least"_a, "threads"_a, "hits"_a,
             "detailed"_a.none(), "transparent"_a.none(), "importance"_a.none())
        .def("shadow_samples", &shadow_samples<T>, "casters"_a, "camera"_a, "image"_a, "options"_a, "light"_a,
             "samples"_a, "least"_a, "one"_a, "seen"_a, "threads"_a, "hits"_a, "transparent"_a.none())
        .def("has_intersections", &has_intersections<T>, "threads"_a)
        .def("hits_at", &seen_at<T>, "camera"_a, "x"_a.noconvert(), "threads"_a)
        .def("trace", &trace_rays<T>, "origins"_a.noconvert(), "directions"_a.noconvert(),
             "ignored"_a.noconvert().none(), "threads"_a)
        .def("visible", &visible_points<T>, "face"_a.noconvert(), "b"_a.noconvert(), "to"_a.noconvert(),
             "contact"_a.noconvert(), "threads"_a);
}

template void bind_scene_for_shaders(nb::class_<SceneArrays<float>>&);
template void bind_scene_for_shaders(nb::class_<SceneArrays<double>>&);

void bind_for_shaders(nb::module_& m) {
    nb::class_<ShadowLightArrays>(m, "LightParts")
        .def(nb::new_(
                 [](In<double, 3> corner, In<double, 1> chance, In<int32_t, 1> face, bool infinite, bool extended,
                    bool two_sided) { return ShadowLightArrays{corner, chance, face, infinite, extended, two_sided}; }),
             "corner"_a.noconvert(), "chance"_a.noconvert(), "face"_a.noconvert(), "infinite"_a, "extended"_a,
             "two_sided"_a);
    m.def("splat", &splat, "x"_a.noconvert(), "values"_a.noconvert(), "filter"_a, "width"_a, "height"_a);
    const auto bind_vjp = [&](auto function) {
        m.def("splat_vjp", function, "x"_a.noconvert(), "image"_a.noconvert(), "filter"_a, "width"_a, "height"_a,
              "threads"_a, "weight"_a.noconvert() = nb::none());
    };
    bind_vjp(&splat_vjp<float>), bind_vjp(&splat_vjp<double>);
    m.def("rays_at", &rays_of, "camera"_a, "x"_a.noconvert(), "intrinsics"_a, "threads"_a);
    bind_pyramid<float>(m), bind_pyramid<double>(m);
}

}  // namespace edgegrad
