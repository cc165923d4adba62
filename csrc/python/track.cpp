// Binds the tracker, for edgegrad/kernel/tracker.py.

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <string>
#include <utility>

#include "python/checks.h"
#include "python/shaped.h"
#include "python/unlocked.h"
#include "track/tracker.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

using Doubles = In<double, 2>;

std::vector<Vec3> vectors(const char* name, const Doubles& a) {
    if (a.shape(1) != 3) refuse(std::string(name) + ": expected three columns");
    check_finite(name, a.data(), a.size(), 3, 1);
    std::vector<Vec3> out(a.shape(0));
    for (size_t i = 0; i < out.size(); ++i) out[i] = {a(i, 0), a(i, 1), a(i, 2)};
    return out;
}

SurfacePoints make_points(Doubles X, Doubles normal, In<float, 3> colors, In<float, 1> texels) {
    SurfacePoints out;
    out.X = vectors("X", X), out.normal = vectors("normal", normal);
    if (out.normal.size() != out.X.size()) refuse("normal: expected one for each point");
    out.find_ranks();
    out.levels = int(colors.shape(0));
    if (out.levels == 0) return out;
    if (colors.shape(1) != out.X.size() || colors.shape(2) != 3 || texels.size() != out.X.size())
        refuse("colors: expected (levels, N, 3), and texels (N,)");
    check_finite("colors", colors.data(), colors.size(), 3, 1);
    out.colors.assign(colors.data(), colors.data() + colors.size());
    out.texels.assign(texels.data(), texels.data() + texels.size());
    for (const float t : out.texels)
        if (!(t > 0)) refuse("texels: expected numbers above zero");
    return out;
}

RigidPose make_pose(const Doubles& R, const In<double, 1>& c) {
    if (R.shape(0) != 3 || R.shape(1) != 3 || c.size() != 3) refuse("pose: expected R (3, 3) and c (3,)");
    check_finite("R", R.data(), 9, 3, 1), check_finite("c", c.data(), 3, 3, 1);
    RigidPose pose;
    for (int i = 0; i < 3; ++i) pose.R.row[i] = {R(i, 0), R(i, 1), R(i, 2)};
    pose.c = {c(0), c(1), c(2)};
    return pose;
}

nb::object array_of(const RigidPose& pose) {
    std::vector<double> out;
    for (int i = 0; i < 3; ++i) {
        const Vec3 r = pose.R.row[i];
        const double t[3] = {pose.c.x, pose.c.y, pose.c.z};
        out.insert(out.end(), {r.x, r.y, r.z, t[i]});
    }
    return shaped(std::move(out), {3, 4});
}

void add(Tracker& tracker, Doubles verts, In<int32_t, 2> faces, const std::vector<double>& spacing,
         const SurfacePoints& textured, const SurfacePoints& surface, Doubles R, In<double, 1> c, int threads) {
    if (verts.shape(1) != 3 || faces.shape(1) != 3) refuse("verts, faces: expected three columns");
    if (faces.shape(0) == 0) refuse("faces: expected at least one");
    check_finite("verts", verts.data(), verts.size(), 3, threads);
    check_indices("faces", faces.data(), faces.size(), verts.shape(0), "verts", threads);
    Spacing of;
    of.first.clear(), of.value.clear();
    for (size_t i = 0; i + 1 < spacing.size(); i += 2)
        of.first.push_back(int32_t(spacing[i])), of.value.push_back(spacing[i + 1]);
    const RigidPose pose = make_pose(R, c);
    unlocked(threads, [&](ThreadTeam& team) {
        tracker.add(std::make_unique<TrackedMesh>(faces.data(), int64_t(faces.shape(0)), verts.data(),
                                                  int64_t(verts.shape(0)), of, textured, surface, team),
                    pose);
    });
}

void check_object(const Tracker& tracker, int object) {
    if (object < 0 || object >= tracker.size()) refuse("object: expected one of those that were added");
}

template <class T>
void check_size(const Tracker& tracker, const char* name, const T& image) {
    if (int(image.shape(0)) != tracker.camera().height() || int(image.shape(1)) != tracker.camera().width())
        refuse(std::string(name) + ": expected the size of the camera's image");
}

nb::dict found(const Tracker& tracker, int object) {
    const TrackedObject& o = tracker.found(object);
    const TrackTimes& t = tracker.times(object);
    nb::dict out, features, times;
    out["pose"] = array_of(o.pose);
    out["covariance"] = shaped(std::vector<double>(o.covariance, o.covariance + 36), {6, 6});
    features["edges"] = o.edges, features["gain"] = o.gain, features["visible"] = o.visible;
    features["residual"] = o.residual, features["texture"] = o.texture, features["texture_noise"] = o.texture_noise;
    features["depth"] = o.depth, features["pixels"] = o.pixels, features["surprise"] = o.surprise;
    features["lines"] = double(o.lines);
    times["read"] = t.read, times["contour"] = t.contour, times["lines"] = t.lines, times["texture"] = t.texture;
    times["depth"] = t.depth, times["solve"] = t.solve, times["learn"] = t.learn;
    out["features"] = features, out["times"] = times;
    return out;
}

nb::list update(Tracker& tracker, std::optional<In<uint8_t, 3>> bytes, std::optional<In<float, 3>> linear,
                std::optional<In<float, 2>> depth, int threads) {
    if (bytes.has_value() == linear.has_value()) refuse("frame: expected either bytes or linear values");
    FrameView view{};
    const auto take = [&](const auto& image) {
        check_size(tracker, "frame", image);
        view.height = int(image.shape(0)), view.width = int(image.shape(1)), view.channels = int(image.shape(2));
        if (view.channels != 1 && view.channels != 3) refuse("frame: expected 1 or 3 channels");
    };
    if (bytes) take(*bytes), view.bytes = bytes->data();
    else take(*linear), view.linear = linear->data();
    DepthView measured{};
    if (depth) {
        check_size(tracker, "depth", *depth);
        measured = {depth->data(), int(depth->shape(1)), int(depth->shape(0))};
    }
    unlocked(threads, [&](ThreadTeam& team) { tracker.update(view, depth ? &measured : nullptr, team); });
    nb::list out;
    for (int i = 0; i < tracker.size(); ++i) out.append(found(tracker, i));
    return out;
}

void place(Tracker& tracker, int object, Doubles R, In<double, 1> c) {
    check_object(tracker, object);
    tracker.place(object, make_pose(R, c));
}

nb::tuple save(Tracker& tracker, int object) {
    check_object(tracker, object);
    std::vector<double> numbers(Tracker::numbers);
    tracker.save(object, numbers.data());
    const auto colors = tracker.colors(object);
    return nb::make_tuple(rows(std::move(numbers)), rows(std::vector<float>(colors.begin(), colors.end())));
}

void load(Tracker& tracker, int object, In<double, 1> numbers, In<float, 1> colors) {
    check_object(tracker, object);
    if (numbers.size() != size_t(Tracker::numbers) || colors.size() != tracker.colors(object).size())
        refuse("state: expected that of a tracker of the same version");
    check_finite("state", numbers.data(), numbers.size(), 1, 1),
        check_finite("state", colors.data(), colors.size(), 1, 1);
    tracker.load(object, numbers.data()), tracker.load_colors(object, colors.data());
}

}  // namespace

void bind_track(nb::module_& m) {
    nb::class_<SurfacePoints>(m, "SurfacePoints")
        .def(nb::new_(&make_points), "X"_a.noconvert(), "normal"_a.noconvert(), "colors"_a.noconvert(),
             "texels"_a.noconvert());
    nb::class_<Tracker>(m, "Tracker")
        .def(nb::init<const Camera&>(), "camera"_a)
        .def("add", &add, "verts"_a.noconvert(), "faces"_a.noconvert(), "spacing"_a, "textured"_a, "surface"_a,
             "R"_a.noconvert(), "c"_a.noconvert(), "threads"_a)
        .def("update", &update, "bytes"_a.none(), "linear"_a.none(), "depth"_a.none(), "threads"_a)
        .def("place", &place, "object"_a, "R"_a.noconvert(), "c"_a.noconvert())
        .def(
            "is_in_view",
            [](Tracker& tracker, int object) {
                check_object(tracker, object);
                return tracker.is_in_view(object);
            },
            "object"_a)
        .def("save", &save, "object"_a)
        .def("load", &load, "object"_a, "numbers"_a.noconvert(), "colors"_a.noconvert());
}

}  // namespace edgegrad
