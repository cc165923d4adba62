// Binds barycentrics of hits as functions of vertices, camera and rays, for edgegrad/points/moving.py.

#include "forward/moving_hits.h"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <array>
#include <optional>

#include "core/array.h"
#include "python/checks.h"
#include "python/shaped.h"
#include "python/unlocked.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

using Doubles = In<double, 2>;

struct HitFaces {
    In<int32_t, 2> faces;
    In<int64_t, 1> face;
    bool perspective;

    // Views hits with several consecutive rays each.
    MovingHits view(const Doubles& along) const {
        const size_t n = face.size();
        return {faces.data(), face.data(), int64_t(n), perspective, n ? int(along.shape(0) / n) : 1};
    }
};
HitFaces make_hits(In<int32_t, 2> faces, In<int64_t, 1> face, bool perspective) {
    if (faces.shape(1) != 3) refuse("faces: expected three columns");
    for (size_t i = 0; i < face.size(); ++i)
        if (face(i) < 0 || face(i) >= int64_t(faces.shape(0))) refuse("face: expected faces of the scene");
    return {faces, face, perspective};
}

void check(const HitFaces& hits, const Doubles& verts, const Doubles& world_to_camera, const Doubles& along) {
    if (verts.shape(1) != 3) refuse("verts: expected three columns");
    check_indices("faces", hits.faces.data(), hits.faces.size(), verts.shape(0), "verts", 1);
    if (world_to_camera.shape(0) != 4 || world_to_camera.shape(1) != 4) refuse("world_to_camera: expected (4, 4)");
    if (along.shape(0) != hits.face.size() * size_t(hits.view(along).rays) || along.shape(1) != 3)
        refuse("along: expected a row a ray, as many for each hit");
}

nb::object barycentrics_of_rays(const HitFaces& hits, Doubles verts, Doubles world_to_camera, Doubles along,
                                int threads) {
    check(hits, verts, world_to_camera, along);
    std::vector<double> b(3 * along.shape(0));
    unlocked(threads, [&](ThreadTeam& team) {
        intersect_planes(hits.view(along), {verts.data(), world_to_camera.data(), along.data()}, b.data(), team);
    });
    return rows(std::move(b), {3});
}

// Returns the wanted cotangents of verts, world_to_camera and along, and None for the others.
nb::tuple barycentrics_of_rays_vjp(const HitFaces& hits, Doubles verts, Doubles world_to_camera, Doubles along,
                                   Doubles bar, std::array<bool, 3> wanted, int threads) {
    check(hits, verts, world_to_camera, along);
    if (bar.shape(0) != along.shape(0) || bar.shape(1) != 3) refuse("bar: expected a row a ray");
    const auto [of_verts, of_pose, of_along] = wanted;
    std::vector<double> verts_bar(of_verts ? verts.size() : 0), pose_bar(of_pose ? 16 : 0),
        along_bar(of_along ? along.size() : 0);
    const auto to = [](std::vector<double>& bar) { return bar.empty() ? nullptr : bar.data(); };
    unlocked(threads, [&](ThreadTeam& team) {
        intersect_planes_vjp(hits.view(along), {verts.data(), world_to_camera.data(), along.data()}, bar.data(),
                             {to(verts_bar), to(pose_bar), to(along_bar)}, team);
    });
    return nb::make_tuple(rows(std::move(verts_bar), {3}), rows(std::move(pose_bar), {4}),
                          rows(std::move(along_bar), {3}));
}

nb::object barycentrics_of_rays_jvp(const HitFaces& hits, Doubles verts, Doubles world_to_camera, Doubles along,
                                    std::optional<Doubles> verts_dot, std::optional<Doubles> pose_dot,
                                    std::optional<Doubles> along_dot, int threads) {
    check(hits, verts, world_to_camera, along);
    const auto tangent = [](const char* name, const std::optional<Doubles>& dot, const Doubles& of) {
        if (!dot) return static_cast<const double*>(nullptr);
        if (dot->shape(0) != of.shape(0) || dot->shape(1) != of.shape(1))
            refuse(std::string(name) + ": expected the shape of the value");
        return dot->data();
    };
    const MovingArrays<const double> tangents{tangent("verts_dot", verts_dot, verts),
                                              tangent("pose_dot", pose_dot, world_to_camera),
                                              tangent("along_dot", along_dot, along)};
    std::vector<double> b_dot(3 * along.shape(0));
    unlocked(threads, [&](ThreadTeam& team) {
        intersect_planes_jvp(hits.view(along), {verts.data(), world_to_camera.data(), along.data()}, tangents,
                             b_dot.data(), team);
    });
    return rows(std::move(b_dot), {3});
}

// Returns the cotangent of the form's table, (R, K).
nb::object form_vjp_by_rows(In<int64_t, 1> sample, In<int64_t, 1> row, Doubles by, In<double, 1> bar, int64_t table,
                            int threads) {
    const size_t n = row.size(), K = by.shape(1);
    if (sample.size() != n || by.shape(0) != n) refuse("form: expected as many samples, rows and derivatives");
    for (size_t i = 0; i < n; ++i)
        if (sample(i) < 0 || sample(i) >= int64_t(bar.size()) || row(i) < 0 || row(i) >= table)
            refuse("form: expected samples and rows that there are");
    Array<double> out(0);
    unlocked(threads, [&](ThreadTeam& team) {
        out = zeros(table * int64_t(K), team);
        form_vjp({sample.data(), row.data(), by.data(), int64_t(n), int64_t(K)}, bar.data(), out.data(), team);
    });
    return shaped(std::move(out), {size_t(table), K});
}

}  // namespace

void bind_moving_hits(nb::module_& m) {
    nb::class_<HitFaces>(m, "MovingHits")
        .def(nb::new_(&make_hits), "faces"_a.noconvert(), "face"_a.noconvert(), "perspective"_a);
    m.def("barycentrics_of_rays", &barycentrics_of_rays, "hits"_a, "verts"_a.noconvert(),
          "world_to_camera"_a.noconvert(), "along"_a.noconvert(), "threads"_a);
    m.def("barycentrics_of_rays_vjp", &barycentrics_of_rays_vjp, "hits"_a, "verts"_a.noconvert(),
          "world_to_camera"_a.noconvert(), "along"_a.noconvert(), "bar"_a.noconvert(), "wanted"_a, "threads"_a);
    m.def("form_vjp", &form_vjp_by_rows, "sample"_a.noconvert(), "row"_a.noconvert(), "by"_a.noconvert(),
          "bar"_a.noconvert(), "table"_a, "threads"_a);
    m.def("barycentrics_of_rays_jvp", &barycentrics_of_rays_jvp, "hits"_a, "verts"_a.noconvert(),
          "world_to_camera"_a.noconvert(), "along"_a.noconvert(), "verts_dot"_a.none(), "pose_dot"_a.none(),
          "along_dot"_a.none(), "threads"_a);
}

}  // namespace edgegrad
