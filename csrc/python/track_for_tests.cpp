// Binds parts of the tracker for tests against oracles.

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <tuple>
#include <utility>

#include "python/checks.h"
#include "python/shaped.h"
#include "track/tracker.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

using Doubles = In<double, 2>;

RigidPose pose_of(const Doubles& M) {
    RigidPose pose;
    for (int i = 0; i < 3; ++i) pose.R.row[i] = {M(i, 0), M(i, 1), M(i, 2)};
    pose.c = {M(0, 3), M(1, 3), M(2, 3)};
    return pose;
}

nb::tuple system_of(const NormalEquations& sum) {
    std::vector<double> H(36), g(sum.g, sum.g + 6);
    for (int a = 0; a < 6; ++a)
        for (int b = 0; b < 6; ++b) H[6 * a + b] = sum.H[std::max(a, b)][std::min(a, b)];
    return nb::make_tuple(shaped(std::move(H), {6, 6}), rows(std::move(g)));
}

// One object before a camera, and the terms of its pose.
struct Probe {
    TrackCamera camera;
    TrackedMesh mesh;
    Frame frame;
    Contour contour;
    ColorHistograms histograms;
    LineTerm lines;
    TextureTerm texture;
    DepthTerm depth;
    std::vector<PosedMesh> posed;

    static TrackedMesh make_mesh(const Doubles& verts, const In<int32_t, 2>& faces, SurfacePoints textured,
                                 SurfacePoints surface) {
        ThreadTeam team(1);
        return TrackedMesh(faces.data(), int64_t(faces.shape(0)), verts.data(), int64_t(verts.shape(0)), {},
                           std::move(textured), std::move(surface), team);
    }
    Probe(const Camera& camera_, Doubles verts, In<int32_t, 2> faces, const SurfacePoints& textured,
          const SurfacePoints& surface, Doubles pose)
        : camera(camera_),
          mesh(make_mesh(verts, faces, textured, surface)),
          frame(camera.width(), camera.height()),
          contour(mesh),
          histograms(mesh),
          texture(mesh),
          depth(mesh),
          posed{{&mesh, pose_of(pose)}} {}
    Probe(const Probe&) = delete;

    void read(In<float, 3> image) {
        frame.begin({nullptr, image.data(), int(image.shape(1)), int(image.shape(0)), int(image.shape(2))});
        frame.require({0, 0, camera.width(), camera.height()});
    }
    // Returns rows of X, x, n, inside, outside.
    nb::object find_contour(double phase, double reach) {
        contour.find({camera, posed}, 0, phase, reach);
        std::vector<double> out;
        for (const ContourPoint& p : contour.points())
            out.insert(out.end(),
                       {p.X.x, p.X.y, p.X.z, p.x.x, p.x.y, p.n.x, p.n.y, double(p.inside), double(p.outside)});
        return rows(std::move(out), {9});
    }
    void learn() { learn_colors(frame, contour.points(), 1, histograms); }
    // Returns rows of mean, variance, gain and share.
    nb::object measure(int segment, bool exact) {
        const double velocity[6] = {};
        lines.measure(frame, histograms, camera, posed[0], contour.points(), {segment, exact, 1e6, velocity});
        std::vector<double> out;
        for (const LineDistance& d : lines.distances()) out.insert(out.end(), {d.mean, d.variance, d.gain, d.share});
        return rows(std::move(out), {4});
    }
    nb::tuple line_system(Doubles pose, double cauchy) {
        const PosedMesh there{&mesh, pose_of(pose)};
        NormalEquations sum;
        lines.add(camera, there, cauchy, sum);
        return system_of(sum);
    }
    std::vector<int> choose_texture() {
        texture.choose_visible({camera, posed}, 0);
        return {texture.chosen().begin(), texture.chosen().end()};
    }
    // Sets the light, and returns the system and the light that it was projected out with.
    nb::tuple texture_system(int level, Doubles pose, Doubles harmonics, double deviation) {
        for (int c = 0; c < 3; ++c)
            for (int a = 0; a < 9; ++a) texture.light.harmonics[c][a] = harmonics(c, a);
        texture.light.deviation = deviation, texture.light.known = true;
        NormalEquations sum;
        texture.add(frame, level, camera, {&mesh, pose_of(pose)}, sum);
        std::vector<double> light(&texture.light.harmonics[0][0], &texture.light.harmonics[0][0] + 27);
        return nb::make_tuple(system_of(sum), shaped(std::move(light), {3, 9}), texture.light.deviation);
    }
    nb::tuple depth_system(In<float, 2> z, Doubles pose) {
        depth.choose_visible({camera, posed}, 0);
        NormalEquations sum;
        depth.add({z.data(), int(z.shape(1)), int(z.shape(0))}, camera, {&mesh, pose_of(pose)}, sum);
        return system_of(sum);
    }
};

}  // namespace

void bind_track_for_tests(nb::module_& p) {
    p.def("track_project", [](const Camera& camera, std::array<double, 3> q) -> nb::object {
        const auto seen = TrackCamera(camera).project({q[0], q[1], q[2]});
        if (!seen) return nb::none();
        return rows(std::vector<double>{seen->x.x, seen->x.y, seen->dx.x, seen->dx.y, seen->dx.z, seen->dy.x,
                                        seen->dy.y, seen->dy.z});
    });
    p.def("track_ray", [](const Camera& camera, std::array<double, 2> x) -> nb::object {
        const auto ray = TrackCamera(camera).ray({x[0], x[1]});
        if (!ray) return nb::none();
        const auto [o, d, end] = *ray;
        return rows(std::vector<double>{o.x, o.y, o.z, d.x, d.y, d.z});
    });
    p.def("track_region", [](In<float, 1> inside) {
        if (int(inside.size()) != RegionModel::segments) refuse("inside: expected a number for each segment");
        const RegionEvidence e = RegionModel().evaluate(inside.data());
        return nb::make_tuple(rows(std::vector<double>(e.log, e.log + RegionEvidence::distances)), double(e.gain));
    });
    p.def("track_edge", [](In<float, 2> I, bool moving, std::array<double, SideModels::count> probability) {
        if (int(I.shape(0)) != EdgeModel::pixels || I.shape(1) != 4) refuse("I: expected (15, 4)");
        SideModels models;
        std::copy(probability.begin(), probability.end(), models.probability);
        float out[EdgeModel::distances];
        double shares[SideModels::count] = {};
        EdgeModel().evaluate(reinterpret_cast<const float (*)[4]>(I.data()), models, moving, out, shares);
        return nb::make_tuple(rows(std::vector<double>(out, out + EdgeModel::distances)),
                              rows(std::vector<double>(shares, shares + SideModels::count)));
    });
    p.def("track_stepped", [](Doubles pose, std::vector<double> d, double size) {
        const RigidPose out = pose_of(pose).stepped(d.data(), size);
        std::vector<double> rows_of;
        for (int i = 0; i < 3; ++i) {
            const Vec3 r = out.R.row[i];
            const double t[3] = {out.c.x, out.c.y, out.c.z};
            rows_of.insert(rows_of.end(), {r.x, r.y, r.z, t[i]});
        }
        return shaped(std::move(rows_of), {3, 4});
    });
    nb::class_<Probe>(p, "TrackProbe")
        .def(nb::init<const Camera&, Doubles, In<int32_t, 2>, const SurfacePoints&, const SurfacePoints&, Doubles>())
        .def_prop_ro("size", [](const Probe& probe) { return probe.mesh.size(); })
        .def("read", &Probe::read)
        .def("contour", &Probe::find_contour, "phase"_a = 0.5, "reach"_a = 20.0)
        .def("learn", &Probe::learn)
        .def("measure", &Probe::measure, "segment"_a, "exact"_a)
        .def("line_system", &Probe::line_system, "pose"_a, "cauchy"_a)
        .def("choose_texture", &Probe::choose_texture)
        .def("texture_system", &Probe::texture_system, "level"_a, "pose"_a, "harmonics"_a, "deviation"_a)
        .def("depth_system", &Probe::depth_system, "z"_a, "pose"_a);
}

}  // namespace edgegrad
