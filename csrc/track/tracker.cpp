#include "track/tracker.h"

#include <algorithm>
#include <cmath>

#include "core/stopwatch.h"

namespace edgegrad {

namespace {

using Settings = TrackSettings;

// Returns the step that leads from one pose to another.
void step_between(const RigidPose& from, const RigidPose& to, double size, double out[6]) {
    const Vec3 w = rotation_vector(product(to.R, transpose(from.R))), t = (1 / size) * (to.c - from.c);
    out[0] = w.x, out[1] = w.y, out[2] = w.z, out[3] = t.x, out[4] = t.y, out[5] = t.z;
}

// Returns the phase of a frame's points on the contour: multiples of the golden ratio spread evenly.
double phase_of(int frame, int scale) {
    const double x = 0.6180339887498949 * (frame * Settings::scales + scale + 1);
    return x - double(int64_t(x));
}

}  // namespace

Tracker::Object::Object(std::unique_ptr<TrackedMesh> mesh_, const TrackCamera& camera)
    : mesh(std::move(mesh_)),
      deviation(Settings::first_deviation),
      frame(camera.width(), camera.height()),
      contour(*mesh),
      histograms(*mesh),
      texture(*mesh),
      depth(*mesh) {
    good.reserve(Settings::candidates);
}

void Tracker::add(std::unique_ptr<TrackedMesh> mesh, const RigidPose& pose) {
    objects_.push_back(std::make_unique<Object>(std::move(mesh), camera_));
    objects_.back()->pose = pose;
    for (const auto& o : objects_) o->posed.resize(objects_.size());
}

RigidPose Tracker::predicted(const Object& object) const {
    return object.pose.stepped(object.velocity, object.mesh->size());
}

void Tracker::update(const FrameView& frame, const DepthView* depth, ThreadTeam& team) {
    // All objects take the others to be where they are predicted, so that their order does not matter.
    for (const auto& object : objects_)
        for (size_t k = 0; k < objects_.size(); ++k)
            object->posed[k] = {objects_[k]->mesh.get(), predicted(*objects_[k])};
    team.parallel_for(size(), [&](int64_t i) { follow(int(i), frame, depth); });
}

double Tracker::pixels_across(const Object& object, const RigidPose& pose) const {
    const auto seen = camera_.project(pose.c);
    if (!seen) return 0;
    return object.mesh->size() * std::sqrt(std::sqrt(dot(seen->dx, seen->dx) * dot(seen->dy, seen->dy)));
}

void Tracker::require_pixels(Object& object, int index, double reach) {
    Vec2 low{1e9, 1e9}, high{-1e9, -1e9};
    const auto hold = [&](Vec2 x) {
        low = {std::min(low.x, x.x), std::min(low.y, x.y)}, high = {std::max(high.x, x.x), std::max(high.y, x.y)};
    };
    for (const ContourPoint& p : object.contour.points()) hold(p.x);
    const RigidPose& pose = object.posed[index].pose;
    for (const int32_t k : object.texture.chosen())
        if (const auto x = camera_.position(pose(object.mesh->textured.X[k]))) hold(*x);
    const auto whole = [](double x) { return int(std::clamp(x, -1e6, 1e6)); };
    if (low.x <= high.x)
        object.frame.require(
            {whole(low.x - reach) - 2, whole(low.y - reach) - 2, whole(high.x + reach) + 3, whole(high.y + reach) + 3});
}

void Tracker::learn(Object& object, double rate, bool all) {
    if (all) return learn_colors(object.frame, object.contour.points(), rate, object.histograms);
    object.good.clear();
    const auto points = object.contour.points();
    const auto distances = object.lines.distances();
    for (size_t i = 0; i < points.size(); ++i)
        if (distances[i].is_close()) object.good.push_back(points[i]);
    learn_colors(object.frame, object.good, rate, object.histograms);
}

void Tracker::follow(int index, const FrameView& frame, const DepthView* depth) {
    Object& object = *objects_[index];
    object.times = {};
    object.frame.begin(frame);
    const RigidPose before = object.pose, start = predicted(object);
    object.posed[index].pose = start;
    if (object.frames == 0) {
        object.contour.find({camera_, object.posed}, index, phase_of(0, 0), Settings::learnt + 2);
        require_pixels(object, index, Settings::learnt + 2);
        learn(object, 1, true);
        descend(index, start, depth);  // The colours were learnt at a pose that may be off.
        learn(object, 1, true);
    }
    descend(index, start, depth);
    object.pose = object.posed[index].pose;
    double offset[6];
    step_between(start, object.pose, object.mesh->size(), offset);
    double square = 0;
    for (const double d : offset) square += d * d / 6;
    object.found.surprise = std::sqrt(square) / object.deviation;
    move(object, before, square);
    Stopwatch watch;
    if (object.found.edges >= Settings::seen) object.lines.learn_models();
    if (object.found.edges >= Settings::seen) learn(object, object.frames ? Settings::learning_rate : 1.0, false);
    object.times.learn = watch.lap();
    ++object.frames, ++object.since;
}

void Tracker::descend(int index, const RigidPose& start, const DepthView* depth) {
    Object& object = *objects_[index];
    TrackTimes& times = object.times;
    PosedMesh& posed = object.posed[index];
    const double size = object.mesh->size(), across = pixels_across(object, posed.pose);
    const double reach = object.deviation * across;  // px
    // Level of the pyramid above which the object is too small.
    const int coarsest = std::max(0, int(std::log2(std::max(across / Settings::pixels_across, 1.0))));
    const Visibility visibility(camera_, object.posed);
    Stopwatch watch;
    if (object.texture.exists()) object.texture.choose_visible(visibility, index), times.texture += watch.lap();
    if (depth) object.depth.choose_visible(visibility, index), times.depth += watch.lap();
    NormalEquations sum;
    double offset[6];
    step_between(start, posed.pose, size, offset);
    for (int k = 0; k < Settings::scales; ++k) {
        const int segment = Settings::scale[k];
        if (segment > std::max(2.0, std::min(reach, across / Settings::segments_across))) continue;
        const double line = std::max<double>((Settings::reach + Settings::side) * segment + 1, Settings::learnt + 2);
        const bool exact = k >= Settings::first_exact;
        object.contour.find(visibility, index, phase_of(object.frames, k), line, exact);
        times.contour += watch.lap();
        require_pixels(object, index, line);
        times.read += watch.lap();
        object.lines.measure(object.frame, object.histograms, camera_, posed, object.contour.points(),
                             {segment, exact, Settings::gate * reach, object.velocity});
        if (exact) object.lines.measure_sharp(object.frame, object.contour.sharp_points());
        times.lines += watch.lap();
        const int level = std::min(Settings::level[k], coarsest);
        const double cauchy = std::max(1.5 * segment, exact ? 0.0 : 2 * reach);
        for (int step = 0; step < Settings::steps[k]; ++step) {
            sum = {};
            object.lines.add(camera_, posed, cauchy, sum);
            times.solve += watch.lap();
            if (object.texture.exists()) {
                object.texture.add(object.frame, level, camera_, posed, sum);
                times.texture += watch.lap();
            }
            if (depth) object.depth.add(*depth, camera_, posed, sum), times.depth += watch.lap();
            sum.add_prior(offset, object.deviation);
            double d[6];
            if (!sum.solve(d)) continue;
            posed.pose = posed.pose.stepped(d, size);
            step_between(start, posed.pose, size, offset);
            times.solve += watch.lap();
        }
    }
    TrackedObject& found = object.found;
    found.pose = posed.pose;
    if (!sum.invert(found.covariance))
        for (int k = 0; k < 36; ++k) found.covariance[k] = k % 7 == 0;  // Nothing is known to a radian and a size.
    const auto distances = object.lines.distances();
    int close = 0;
    double gain = 0;
    for (const LineDistance& d : distances) close += d.is_close(), gain += std::max(d.gain, 0.f);
    found.lines = int(distances.size());
    found.edges = double(close) / std::max(found.lines, Settings::lines / 4);
    found.gain = found.lines ? gain / found.lines : 0;
    found.visible = object.contour.visible_share();
    found.residual = object.lines.residual(camera_, posed);
    // The variances of lines are too small or too large by as much as their residuals are.
    const double spread = std::max(found.residual, Settings::least_residual);
    for (double& v : found.covariance) v *= Settings::inflation * spread * spread;
    found.texture = object.texture.exists() ? object.texture.explained() : 0;
    found.texture_noise = object.texture.exists() ? object.texture.light.deviation : 0;
    found.depth = depth ? object.depth.explained() : 0;
    found.pixels = across;
    times.solve += watch.lap();
}

// The velocity takes half of the difference of two poses, which has the errors of both.
void Tracker::move(Object& object, const RigidPose& before, double square) {
    const bool known = object.since > 1 && object.found.edges >= 1.5 * Settings::seen;
    if (known) {
        const double rate = Settings::deviation_rate;
        object.deviation = std::sqrt((1 - rate) * object.deviation * object.deviation + rate * square);
    }
    if (object.since > 0)
        object.deviation = std::clamp(object.deviation, Settings::least_deviation, Settings::greatest_deviation);
    double step[6];
    step_between(before, object.pose, object.mesh->size(), step);
    const double rate = object.since > 1 ? Settings::velocity_rate : object.since;
    for (int k = 0; k < 6; ++k) object.velocity[k] += rate * (step[k] - object.velocity[k]);
}

void Tracker::place(int index, const RigidPose& pose) {
    Object& object = *objects_[index];
    object.pose = pose;
    std::fill(object.velocity, object.velocity + 6, 0.0);
    object.deviation = Settings::first_deviation;
    object.since = 0;
    object.texture.light = {};  // It may be that of something else by now.
}

bool Tracker::is_in_view(int index) {
    Object& object = *objects_[index];
    for (size_t k = 0; k < objects_.size(); ++k) object.posed[k] = {objects_[k]->mesh.get(), objects_[k]->pose};
    object.contour.find({camera_, object.posed}, index, 0.5, Settings::learnt + 2);
    return !object.contour.points().empty();
}

void Tracker::save(int index, double* out) const {
    const Object& o = *objects_[index];
    for (const Vec3& r : o.pose.R.row) *out++ = r.x, *out++ = r.y, *out++ = r.z;
    *out++ = o.pose.c.x, *out++ = o.pose.c.y, *out++ = o.pose.c.z;
    out = std::copy(o.velocity, o.velocity + 6, out);
    *out++ = o.deviation, *out++ = o.frames, *out++ = o.since;
    const TextureTerm::Light& light = o.texture.light;
    for (const auto& channel : light.harmonics) out = std::copy(channel, channel + 9, out);
    *out++ = light.deviation, *out++ = light.known;
    out = std::copy(o.lines.models.probability, o.lines.models.probability + SideModels::count, out);
    *out = o.contour.outline_share();
}

void Tracker::load(int index, const double* in) {
    Object& o = *objects_[index];
    for (Vec3& r : o.pose.R.row) r.x = *in++, r.y = *in++, r.z = *in++;
    o.pose.c = {in[0], in[1], in[2]}, in += 3;
    std::copy(in, in + 6, o.velocity), in += 6;
    o.deviation = *in++, o.frames = int(*in++), o.since = int(*in++);
    TextureTerm::Light& light = o.texture.light;
    for (auto& channel : light.harmonics) std::copy(in, in + 9, channel), in += 9;
    light.deviation = *in++, light.known = *in++ != 0;
    std::copy(in, in + SideModels::count, o.lines.models.probability), in += SideModels::count;
    o.contour.set_outline_share(*in);
}

void Tracker::load_colors(int index, const float* in) {
    ColorHistograms& histograms = objects_[index]->histograms;
    std::copy(in, in + histograms.state().size(), histograms.state().begin());
    histograms.restore();
}

}  // namespace edgegrad
