// Binds edgegrad/raster's operators on clip-space triangles: rasterize, interpolate, sample textures, antialias.

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "python/checks.h"
#include "python/shaped.h"
#include "python/unlocked.h"
#include "raster/antialias.h"
#include "raster/interpolate.h"
#include "raster/rasterize.h"
#include "raster/sample_texture.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

// Holds positions (1 or images, vertices, 4) with triangles, and ranges where the images have different ones.
template <class T>
struct ClipMesh {
    In<T, 3> pos;
    In<int32_t, 2> tri;
    std::optional<In<int32_t, 2>> ranges;

    ClipMesh(In<T, 3> pos_, In<int32_t, 2> tri_, std::optional<In<int32_t, 2>> ranges_, int threads)
        : pos(pos_), tri(tri_), ranges(ranges_) {
        if (pos.shape(2) != 4) refuse("pos: expected four columns");
        if (tri.shape(1) != 3) refuse("tri: expected three columns");
        check_indices("tri", tri.data(), tri.size(), pos.shape(1), "pos", threads);
        if (!ranges) return;
        if (pos.shape(0) != 1 || ranges->shape(1) != 2)
            refuse("ranges: expected (images, 2), and positions (vertices, 4)");
        for (size_t i = 0; i < ranges->shape(0); ++i) {
            const int64_t first = (*ranges)(i, 0), count = (*ranges)(i, 1);
            if (first < 0 || count < 0 || first + count > int64_t(tri.shape(0)))
                refuse("ranges: expected a first triangle and a number of them within tri, at [" + std::to_string(i) +
                       "]");
        }
    }
    int64_t images() const { return ranges ? ranges->shape(0) : pos.shape(0); }
    Triangles<T> view() const {
        return {pos.data(), int64_t(pos.shape(1)), pos.shape(0) == 1,
                tri.data(), int64_t(tri.shape(0)), ranges ? ranges->data() : nullptr};
    }
};

Frames frames_of(int64_t count, int64_t height, int64_t width) {
    if (height < 1 || width < 1) refuse("resolution: expected a height and a width of 1 and more");
    return {count, height, width};
}

std::vector<size_t> shape_of(const Frames& f, int64_t channels) {
    return {size_t(f.count), size_t(f.height), size_t(f.width), size_t(channels)};
}

template <class T>
Frames frames_of(const In<T, 4>& image) {
    return frames_of(image.shape(0), image.shape(1), image.shape(2));
}

template <class T>
void check_shape(const char* name, const In<T, 4>& image, const Frames& f, int64_t channels) {
    if (int64_t(image.shape(0)) != f.count || int64_t(image.shape(1)) != f.height ||
        int64_t(image.shape(2)) != f.width || int64_t(image.shape(3)) != channels)
        refuse(std::string(name) + ": expected a number for each pixel and channel of rast");
}

// Checks that the triangles of each pixel belong to its image; ranges are (first, end).
template <class T, class Range>
void check_triangles(const In<T, 4>& rast, Range range, int threads) {
    const Frames f = frames_of(rast);
    check_shape("rast", rast, f, 4);
    const int64_t pixels = f.height * f.width;
    const auto is_wrong = [&](int64_t p) {
        const T id = rast.data()[4 * p + 3];
        const auto [low, high] = range(p / pixels);
        return !(id == 0 || (id >= T(low + 1) && id <= T(high)));
    };
    const auto first_wrong = [&](int64_t first, int64_t last) {
        while (first < last && !is_wrong(first)) ++first;
        return first;
    };
    if (all_pass(f.pixels(), threads, [&](int64_t first, int64_t last) { return first_wrong(first, last) == last; }))
        return;
    const int64_t p = first_wrong(0, f.pixels());
    const auto [low, high] = range(p / pixels);
    refuse("rast: expected numbers of triangles from " + std::to_string(low + 1) + " to " + std::to_string(high) +
           ", or 0, in the last channel, got " + std::to_string(rast.data()[4 * p + 3]) + " at [" +
           std::to_string(p / pixels) + ", " + std::to_string(p % pixels / f.width) + ", " +
           std::to_string(p % f.width) + ", 3]; give the tri that was rasterized");
}

template <class T>
nb::object image_of(Array<T>&& values, const Frames& f) {
    const int64_t channels = values.size() / std::max<int64_t>(1, f.pixels());
    return shaped(std::move(values), shape_of(f, channels));
}

template <class T>
nb::object or_none(std::optional<Array<T>>&& values, const std::vector<size_t>& shape) {
    return values ? shaped(std::move(*values), shape) : nb::none();
}

template <class T>
const T* pointer(const std::optional<In<T, 4>>& a) {
    return a ? a->data() : nullptr;
}

template <class T>
void bind_rasterize(nb::module_& m) {
    m.def(
        "rasterize",
        [](In<T, 3> pos, In<int32_t, 2> tri, std::optional<In<int32_t, 2>> ranges, int64_t height, int64_t width,
           std::optional<In<T, 3>> behind, bool derivatives, int threads) {
            const ClipMesh<T> mesh(pos, tri, ranges, threads);
            check_finite("pos", pos.data(), pos.size(), 4, threads);
            const Frames frames = frames_of(mesh.images(), height, width);
            if (behind && int64_t(behind->size()) != frames.pixels()) refuse("behind: expected a number a pixel");
            auto found = unlocked(threads, [&](ThreadTeam& team) {
                return rasterize(mesh.view(), frames, behind ? behind->data() : nullptr, derivatives, team);
            });
            return nb::make_tuple(shaped(std::move(found.rast), shape_of(frames, 4)),
                                  shaped(std::move(found.rast_db), shape_of(frames, derivatives ? 4 : 0)));
        },
        "pos"_a.noconvert(), "tri"_a.noconvert(), "ranges"_a.noconvert().none(), "height"_a, "width"_a,
        "behind"_a.noconvert().none(), "derivatives"_a, "threads"_a);
    m.def(
        "rasterize_vjp",
        [](In<T, 3> pos, In<int32_t, 2> tri, std::optional<In<int32_t, 2>> ranges, In<T, 4> rast, In<T, 4> rast_bar,
           std::optional<In<T, 4>> db_bar, int threads) {
            const ClipMesh<T> mesh(pos, tri, ranges, threads);
            const Triangles<T> view = mesh.view();
            const Frames frames = frames_of(rast);
            check_triangles(rast, [&](int64_t i) { return std::pair(view.first(i), view.end(i)); }, threads);
            check_shape("rast_bar", rast_bar, frames, 4);
            if (db_bar) check_shape("db_bar", *db_bar, frames, 4);
            Array<T> found = unlocked(threads, [&](ThreadTeam& team) {
                return rasterize_vjp(view, frames, rast.data(), rast_bar.data(), pointer(db_bar), team);
            });
            return shaped(std::move(found), {pos.shape(0), pos.shape(1), 4});
        },
        "pos"_a.noconvert(), "tri"_a.noconvert(), "ranges"_a.noconvert().none(), "rast"_a.noconvert(),
        "rast_bar"_a.noconvert(), "db_bar"_a.noconvert().none(), "threads"_a);
}

// Holds attributes (1 or images, vertices, width) and the rasterizer's output at which they are interpolated.
template <class T>
struct Interpolation {
    In<T, 3> attr;
    In<T, 4> rast;
    In<int32_t, 2> tri;
    std::optional<In<T, 4>> rast_db;
    std::vector<int> chosen;

    void check(int threads) const {
        const Frames frames = frames_of(rast);
        if (attr.shape(0) != 1 && int64_t(attr.shape(0)) != frames.count)
            refuse("attr: expected attributes for each image of rast, or one for all");
        if (tri.shape(1) != 3) refuse("tri: expected three columns");
        check_indices("tri", tri.data(), tri.size(), attr.shape(1), "attr", threads);
        check_triangles(rast, [&](int64_t) { return std::pair<int64_t, int64_t>(0, tri.shape(0)); }, threads);
        if (rast_db) check_shape("rast_db", *rast_db, frames, 4);
        if (!rast_db && !chosen.empty()) refuse("diff_attrs: expected rast_db with it");
        for (const int c : chosen)
            if (c < 0 || c >= int(attr.shape(2))) refuse("diff_attrs: expected numbers of attributes");
    }
    VertexAttributes<T> attributes() const {
        return {attr.data(), int64_t(attr.shape(1)), int(attr.shape(2)), attr.shape(0) == 1};
    }
    RasterView<T> view() const {
        return {frames_of(rast), tri.data(), int64_t(tri.shape(0)), rast.data(), pointer(rast_db)};
    }
};

template <class T>
void bind_interpolate(nb::module_& m) {
    m.def(
        "interpolate",
        [](In<T, 3> attr, In<T, 4> rast, In<int32_t, 2> tri, std::optional<In<T, 4>> rast_db, std::vector<int> chosen,
           int threads) {
            const Interpolation<T> in{attr, rast, tri, rast_db, std::move(chosen)};
            in.check(threads);
            auto found = unlocked(
                threads, [&](ThreadTeam& team) { return interpolate(in.attributes(), in.view(), in.chosen, team); });
            const Frames frames = frames_of(rast);
            return nb::make_tuple(shaped(std::move(found.values), shape_of(frames, attr.shape(2))),
                                  shaped(std::move(found.da), shape_of(frames, 2 * int64_t(in.chosen.size()))));
        },
        "attr"_a.noconvert(), "rast"_a.noconvert(), "tri"_a.noconvert(), "rast_db"_a.noconvert().none(), "chosen"_a,
        "threads"_a);
    m.def(
        "interpolate_vjp",
        [](In<T, 3> attr, In<T, 4> rast, In<int32_t, 2> tri, std::optional<In<T, 4>> rast_db, std::vector<int> chosen,
           std::optional<In<T, 4>> bar, std::optional<In<T, 4>> da_bar, std::array<bool, 3> wanted, int threads) {
            const Interpolation<T> in{attr, rast, tri, rast_db, std::move(chosen)};
            in.check(threads);
            const Frames frames = frames_of(rast);
            if (bar) check_shape("bar", *bar, frames, attr.shape(2));
            if (da_bar) check_shape("da_bar", *da_bar, frames, 2 * int64_t(in.chosen.size()));
            auto found = unlocked(threads, [&](ThreadTeam& team) {
                return interpolate_vjp(in.attributes(), in.view(), in.chosen, pointer(bar), pointer(da_bar),
                                       {wanted[0], wanted[1], wanted[2]}, team);
            });
            return nb::make_tuple(or_none(std::move(found.attr), {attr.shape(0), attr.shape(1), attr.shape(2)}),
                                  or_none(std::move(found.rast), shape_of(frames, 4)),
                                  or_none(std::move(found.rast_db), shape_of(frames, 4)));
        },
        "attr"_a.noconvert(), "rast"_a.noconvert(), "tri"_a.noconvert(), "rast_db"_a.noconvert().none(), "chosen"_a,
        "bar"_a.noconvert().none(), "da_bar"_a.noconvert().none(), "wanted"_a, "threads"_a);
}

constexpr const char *border_names[] = {"wrap", "clamp", "zero", "cube"},
                     *look_up_names[] = {"nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear"};

int index_of(const char* argument, const char* const (&names)[4], const std::string& name) {
    const auto found = std::find(std::begin(names), std::end(names), name);
    if (found == std::end(names)) refuse(std::string(argument) + ": unknown name " + name);
    return int(found - std::begin(names));
}

// Holds images, height, width, channels and levels of the texels, and how they are sampled.
struct TextureOptions {
    TextureShape shape;
    LookUp look_up;
};
TextureOptions make_texture_options(std::array<int64_t, 5> shape, const std::string& border,
                                    const std::string& filter) {
    for (const int64_t n : shape)
        if (n < 1) refuse("tex: expected texels");
    return {{shape[0], shape[1], shape[2], int(shape[3]), int(shape[4]),
             BoundaryMode(index_of("boundary_mode", border_names, border))},
            LookUp(index_of("filter_mode", look_up_names, filter))};
}

template <class T>
TextureInput<T> texture_input(const TextureOptions& options, const In<T, 1>& texels, const In<T, 4>& uv,
                              const std::optional<In<T, 4>>& uv_da, const std::optional<In<T, 3>>& bias) {
    const Frames frames = frames_of(uv);
    const TextureInput<T> in{options.shape,
                             options.look_up,
                             frames,
                             texels.data(),
                             uv.data(),
                             pointer(uv_da),
                             bias ? bias->data() : nullptr};
    if (int64_t(texels.size()) != options.shape.all_texels() * options.shape.channels)
        refuse("tex: expected all texels");
    if (options.shape.images != 1 && options.shape.images != frames.count)
        refuse("tex: expected a texture for each image of uv, or one for all");
    check_shape("uv", uv, frames, in.coordinates());
    if (uv_da) check_shape("uv_da", *uv_da, frames, 2 * in.coordinates());
    if (bias && int64_t(bias->size()) != frames.pixels()) refuse("mip_level_bias: expected a number a pixel");
    return in;
}

template <class T>
void bind_texture(nb::module_& m) {
    m.def(
        "sample_texture",
        [](const TextureOptions& options, In<T, 1> texels, In<T, 4> uv, std::optional<In<T, 4>> uv_da,
           std::optional<In<T, 3>> bias, int threads) {
            const TextureInput<T> in = texture_input(options, texels, uv, uv_da, bias);
            Array<T> found = unlocked(threads, [&](ThreadTeam& team) { return sample_texture(in, team); });
            return shaped(std::move(found), shape_of(in.frames, options.shape.channels));
        },
        "options"_a, "texels"_a.noconvert(), "uv"_a.noconvert(), "uv_da"_a.noconvert().none(),
        "bias"_a.noconvert().none(), "threads"_a);
    m.def(
        "sample_texture_vjp",
        [](const TextureOptions& options, In<T, 1> texels, In<T, 4> uv, std::optional<In<T, 4>> uv_da,
           std::optional<In<T, 3>> bias, In<T, 4> bar, std::array<bool, 4> wanted, int threads) {
            const TextureInput<T> in = texture_input(options, texels, uv, uv_da, bias);
            const Frames& f = in.frames;
            check_shape("bar", bar, f, options.shape.channels);
            auto found = unlocked(threads, [&](ThreadTeam& team) {
                return sample_texture_vjp(in, bar.data(), {wanted[0], wanted[1], wanted[2], wanted[3]}, team);
            });
            return nb::make_tuple(or_none(std::move(found.texels), {texels.size()}),
                                  or_none(std::move(found.uv), shape_of(f, in.coordinates())),
                                  or_none(std::move(found.uv_da), shape_of(f, 2 * in.coordinates())),
                                  or_none(std::move(found.bias), {size_t(f.count), size_t(f.height), size_t(f.width)}));
        },
        "options"_a, "texels"_a.noconvert(), "uv"_a.noconvert(), "uv_da"_a.noconvert().none(),
        "bias"_a.noconvert().none(), "bar"_a.noconvert(), "wanted"_a, "threads"_a);
}

// Groups the half-edges with the same vertices.
struct EdgeArrays {
    In<int32_t, 1> group, start, member;

    EdgeGroups view(size_t triangles) const {
        if (group.size() != 3 * triangles || member.size() != 3 * triangles || start.size() < 1)
            refuse("topology_hash: expected that of these triangles; make it of `tri` anew");
        return {group.data(), start.data(), member.data()};
    }
};

struct SilhouetteCrossings {
    std::vector<SilhouetteCrossing> all;
};

template <class T>
void bind_antialias(nb::module_& m) {
    m.def(
        "find_crossings",
        [](In<T, 3> pos, In<int32_t, 2> tri, const EdgeArrays& edges, In<T, 4> rast, int threads) {
            const ClipMesh<T> mesh(pos, tri, std::nullopt, threads);
            const Triangles<T> view = mesh.view();
            const Frames frames = frames_of(rast);
            if (mesh.images() != frames.count && !view.shared) refuse("pos: expected positions for each image of rast");
            check_finite("pos", pos.data(), pos.size(), 4, threads);
            check_triangles(rast, [&](int64_t i) { return std::pair(view.first(i), view.end(i)); }, threads);
            const EdgeGroups groups = edges.view(tri.shape(0));
            return SilhouetteCrossings{unlocked(
                threads, [&](ThreadTeam& team) { return find_crossings(view, frames, groups, rast.data(), team); })};
        },
        "pos"_a.noconvert(), "tri"_a.noconvert(), "edges"_a, "rast"_a.noconvert(), "threads"_a);
    m.def(
        "antialias",
        [](const SilhouetteCrossings& crossings, In<T, 4> color, int threads) {
            const Frames frames = frames_of(color);
            return image_of(unlocked(threads,
                                     [&](ThreadTeam& team) {
                                         return antialias(crossings.all, frames, int(color.shape(3)), color.data(),
                                                          team);
                                     }),
                            frames);
        },
        "crossings"_a, "color"_a.noconvert(), "threads"_a);
    m.def(
        "antialias_vjp",
        [](const SilhouetteCrossings& crossings, In<T, 3> pos, In<int32_t, 2> tri, In<T, 4> color, In<T, 4> bar,
           std::array<bool, 2> wanted, int threads) {
            const ClipMesh<T> mesh(pos, tri, std::nullopt, threads);
            const Frames frames = frames_of(color);
            check_shape("bar", bar, frames, color.shape(3));
            auto found = unlocked(threads, [&](ThreadTeam& team) {
                return antialias_vjp(crossings.all, mesh.view(), frames, int(color.shape(3)), color.data(), bar.data(),
                                     {wanted[0], wanted[1]}, team);
            });
            return nb::make_tuple(or_none(std::move(found.color), shape_of(frames, color.shape(3))),
                                  or_none(std::move(found.pos), {pos.shape(0), pos.shape(1), 4}));
        },
        "crossings"_a, "pos"_a.noconvert(), "tri"_a.noconvert(), "color"_a.noconvert(), "bar"_a.noconvert(), "wanted"_a,
        "threads"_a);
}

template <class T>
void bind_all(nb::module_& m) {
    bind_rasterize<T>(m), bind_interpolate<T>(m), bind_texture<T>(m), bind_antialias<T>(m);
}

}  // namespace

void bind_raster(nb::module_& m) {
    nb::class_<TextureOptions>(m, "TextureOptions")
        .def(nb::new_(&make_texture_options), "shape"_a, "border"_a, "filter"_a);
    nb::class_<EdgeArrays>(m, "EdgeGroups")
        .def(nb::init<In<int32_t, 1>, In<int32_t, 1>, In<int32_t, 1>>(), "group"_a.noconvert(), "start"_a.noconvert(),
             "member"_a.noconvert());
    nb::class_<SilhouetteCrossings>(m, "Crossings").def("__len__", [](const SilhouetteCrossings& c) {
        return c.all.size();
    });
    bind_all<float>(m), bind_all<double>(m);
}

}  // namespace edgegrad
