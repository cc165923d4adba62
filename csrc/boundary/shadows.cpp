// Samples on the borders of shadows.
//
// Edges that cast shadows are cut into segments, few of long ones. Some rays along each, pilots, from the light past
// the edge to whatever they meet, and from the camera to there, say how long the border's image is and how much light
// ends there; the samples go in proportion to the root mean square of that product over a segment, with a floor.

#include "boundary/shadows.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "boundary/curve_samples.h"
#include "boundary/shadow_edges.h"
#include "boundary/shadow_source.h"
#include "core/sampler.h"
#include "core/stopwatch.h"
#include "core/systematic.h"
#include "rays/meeting.h"
#include "shading/cut_outs.h"

namespace edgegrad {

namespace {

constexpr int64_t pair_tests = 1 << 23;  // of edges before points of lights
// Into how many segments edges are cut, along themselves before a light that is a point, else by parts of the light.
constexpr int64_t cuts = 1 << 10, cuts_of_light = 1 << 14;
constexpr int64_t most_segments = 1 << 16;
constexpr int most_of_edge = 64;
constexpr int64_t points_of_segment = 8;  // at least, of a part of a light
constexpr int pilots = 4;                 // a segment
constexpr double floor_share = 0.2;       // of the density that pilots do not decide
constexpr double samples_a_pixel = 24;    // of the border of a point's shadow
constexpr int64_t fewest_samples = 256, most_samples = 1 << 18;

struct Segment {
    ShadowEdge edge;
    double t0, t1;

    int64_t points() const { return edge.end - edge.first; }
    // What it stands for: of the mean over the points of its light, and of the edge.
    double share() const { return edge.weight * double(points()) * (t1 - t0); }
};

// Edges cut in proportion to their measure; drawn from, where there are too many.
template <class T>
std::vector<Segment> segments_of(const BackwardView<T>& view, const std::vector<ShadowEdge>& edges) {
    std::vector<Segment> out;
    if (edges.empty()) return out;
    Array<double> measure(int64_t(edges.size()));
    for (size_t i = 0; i < edges.size(); ++i) measure[i] = edges[i].measure;
    Systematic systematic(measure, view.team);
    if (!(systematic.total() > 0)) return out;
    if (int64_t(edges.size()) > most_segments) {
        systematic.draw(most_segments, to_unit(hash(view.options.seed, 9, gradient_stream)));
        int64_t k = 0;
        for (int64_t i = 0; i < most_segments; ++i) {
            const double position = systematic.position(i);
            k = i ? systematic.primitive(position, k) : systematic.primitive(position);
            ShadowEdge edge = edges[k];
            edge.weight *= systematic.weight(k), edge.measure *= systematic.weight(k);
            out.push_back({edge, 0, 1});
        }
        return out;
    }
    for (size_t i = 0; i < edges.size(); ++i) {
        const ShadowEdge& edge = edges[i];
        const int64_t points = edge.end - edge.first;
        const bool by_light = points > 1;
        const double share = systematic.measure_of(int64_t(i)) / systematic.total();
        const double most = by_light ? std::max<double>(1, double(points / points_of_segment)) : most_of_edge;
        const int64_t n = int64_t(std::clamp(std::round(share * double(by_light ? cuts_of_light : cuts)), 1.0, most));
        for (int64_t k = 0; k < n; ++k) {
            Segment segment{edge, double(k) / double(n), double(k + 1) / double(n)};
            if (by_light) {
                segment.t0 = 0, segment.t1 = 1;
                segment.edge.first = edge.first + points * k / n, segment.edge.end = edge.first + points * (k + 1) / n;
                segment.edge.measure *= double(segment.points()) / double(points);
            }
            out.push_back(segment);
        }
    }
    return out;
}

// Rays from points of lights past edges, in batches, and what they meet behind.
template <class T>
class LightRays {
   public:
    LightRays(const BackwardView<T>& view, const LightPoints& lights) : view_(view), lights_(lights) {}

    // The point at t of an edge, for whoever knows the segment by this number.
    void add(int64_t edge, ShadowEdges::Point from, int64_t segment, double t, double weight) {
        const HalfEdge& h = view_.geometry.topology().half_edges(edge)[0];
        const SceneView<T>& scene = view_.scene;
        const auto vertex_of = [&](int c) { return scene.faces[3 * int64_t(h.face) + c]; };
        const Vec3 a = corner(scene, h.face, h.first()), b = corner(scene, h.face, h.second());
        Waiting& w = waiting_[count_];
        w.point = {.a = vertex_of(h.first()),
                   .b = vertex_of(h.second()),
                   .light = from.light,
                   .caster = from.caster,
                   .face = -1,
                   .segment = segment,
                   .t = t,
                   .on = {},
                   .along = 0};
        w.weight = weight;
        w.edge = edge;
        w.infinite = lights_.infinite[from.light];
        w.p = (1 - t) * a + t * b;
        const Vec3 light = lights_.at(from.light);
        if (w.infinite) {
            // From outside of the scene.
            const RayFrame& frame = view_.geometry.caster().frame();
            w.before = (4 * frame.radius * frame.unit + length(w.p - frame.centre)) / length(light);
            w.ray = {w.p + w.before * light, -light};
        } else {
            w.before = 1;
            w.ray = {light, w.p - light};
        }
        auto& without = without_[count_];
        const auto beside = view_.geometry.topology().faces(edge);
        without.assign(beside.begin(), beside.end());
        if (const int32_t own = lights_.face[from.light]; own >= 0) without.push_back(own);
        std::sort(without.begin(), without.end());
        ++count_;
    }

    bool is_full() const { return count_ == RayBatch::size; }

    // Calls body(ShadowPoint, weight) for those past which light goes on to a face.
    template <class Body>
    void cast(Body body) {
        int32_t face[RayBatch::size];
        Meeting met[RayBatch::size];
        cast_each(
            view_.geometry.caster(), count_, face, without_, [&](int i) { return waiting_[i].ray; },
            [&](int i, int32_t f) { return accept(waiting_[i], f, met[i]); });
        for (int i = 0; i < count_; ++i) {
            Waiting& w = waiting_[i];
            // What it meets first lies before the edge, or touches it: then the shadow begins there, along a curve that
            // the camera sees as an edge.
            if (face[i] < 0 || met[i].t <= w.before + touching(w, face[i])) continue;
            w.point.face = face[i], w.point.on = inside({met[i].u, met[i].v});
            w.point.along = w.infinite ? met[i].t - w.before : met[i].t;
            body(w.point, w.weight);
        }
        count_ = 0;
    }

   private:
    struct Waiting {
        ShadowPoint point;
        double weight;
        int64_t edge;
        bool infinite;
        Vec3 p;  // of the edge, world coordinates
        Ray ray;
        double before;  // where the edge lies on the ray, in lengths of its direction
    };

    bool accept(const Waiting& w, int32_t face, Meeting& m) const {
        m = meet(view_.scene, face, w.ray);
        if (!m.exists() || m.t <= 0 || m.margin() < -Meeting::rounding) return false;
        // On the border of a face, as that of a box in whose side the light lies, it goes by or not as it would had the
        // light moved a little (FacesBeforeLights).
        if (m.margin() <= Meeting::rounding) {
            constexpr double little = 1e-7;
            const Vec3 moved = (little * length(w.ray.direction)) * FacesBeforeLights<T>::aside;
            const Vec3 origin = w.ray.origin + (w.infinite ? w.before : 1) * moved;
            const Meeting beside = meet(view_.scene, face, {origin, w.p - origin});
            if (!beside.exists() || beside.margin() < 0) return false;
        }
        // The light itself, of which the point lies on this face or one beside it.
        if (lights_.face[w.point.light] >= 0 && m.t <= touching(w, face)) return false;
        return shows(view_.scene, face, inside({m.u, m.v}));
    }

    // How far along its ray an edge may lie from a face that it touches, up to the rounding of the input.
    double touching(const Waiting& w, int32_t face) const {
        const SceneView<T>& scene = view_.scene;
        for (const int32_t beside : view_.geometry.topology().faces(w.edge))
            if (share_vertex(scene, face, beside)) return Meeting::rounding * w.before;
        const int32_t* v = scene.faces + 3 * int64_t(face);
        double size = 0;
        for (int i = 0; i < 3; ++i)
            for (int axis = 0; axis < 3; ++axis)
                size = std::max(size, std::fabs(scene.verts[3 * int64_t(v[i]) + axis]));
        const Vec3 q = corner(scene, face, 0);
        const Vec3 m = cross(corner(scene, face, 1) - q, corner(scene, face, 2) - q);
        const double spacing = std::max(scene.spacing->of(v[0]), scene.spacing->of(w.point.a));
        // Across the face, so along the ray it is more the more this grazes it.
        return contact(spacing, size, size) * length(m) / std::fabs(dot(m, w.ray.direction));
    }

    const BackwardView<T>& view_;
    const LightPoints& lights_;
    Waiting waiting_[RayBatch::size];
    std::vector<int32_t> without_[RayBatch::size];
    int count_ = 0;
};

// Whether the filter of a pixel reaches x, and what is there belongs to this window.
template <class T>
bool is_in_view(const BackwardView<T>& view, Vec3 y) {
    return view.camera.depth_weight(y) > 0 && view.volume.outcode(y) == 0;
}

// What pilots find of a segment.
struct Found {
    double squares = 0;  // Σ (length · light)²
    double length = 0;   // Σ length, px
};

// The contraction of pilots.
template <class T>
class Pilots {
   public:
    Pilots(const BackwardView<T>& view, const LightPoints& lights, std::vector<Found>& found)
        : view_(view), lights_(lights), found_(found) {}

    bool wants(int, Vec2) const { return true; }

    void add(int, ShadowSource<T>& source, typename ShadowSource<T>::Sample& sample) {
        const ShadowPoint& point = sample.shadow;
        const Vec3 y = source.place_of(point), m = sample.m;
        const Vec3 light = lights_.at(point.light);
        const Vec3 d = lights_.infinite[point.light] ? view_.camera.R * light : view_.camera.to_camera(light) - y;
        const double squared = dot(d, d), cosine = std::fabs(dot(m, d)) / (length(m) * std::sqrt(squared));
        const double arriving = lights_.power[point.light] * cosine / (lights_.infinite[point.light] ? 1 : squared);
        const double look = view_.importance.mean(sample.x, sample.x);
        const double px = sample.speed * std::sqrt(std::fabs(sample.area_scale));
        const double value = px * arriving * look;
        if (!std::isfinite(value)) return;
        found_[point.segment].squares += value * value, found_[point.segment].length += look > 0 ? px : 0;
    }

   private:
    const BackwardView<T>& view_;
    const LightPoints& lights_;
    std::vector<Found>& found_;
};

// Casts a chunk of points on segments from their lights, and from the camera what they are seen to meet.
template <class T, class Contraction>
class ShadowChunk {
   public:
    ShadowChunk(const BackwardView<T>& view, const LightPoints& lights, const std::vector<ShadowEdges::Point>& points,
                Contraction contraction)
        : view_(view),
          points_(points),
          source_(view, lights),
          light_rays_(view, lights),
          samples_(view, source_, std::move(contraction)) {}

    // At a fraction of a segment: the points of the light one after another, each with all of the segment. Where these
    // are more than samples, samples would all meet the same place of the segment if it were not moved on by the golden
    // ratio from one point to the next.
    void add(const Segment& segment, int64_t index, double fraction, double weight) {
        const int64_t count = segment.points();
        const double at = fraction * double(count);
        const int64_t point = std::min(int64_t(at), count - 1);
        double t = at - double(point);
        if (count > 1) t += double(segment.edge.first + point) * 0.6180339887498949, t -= std::floor(t);
        light_rays_.add(segment.edge.edge, points_[segment.edge.first + point], index,
                        segment.t0 + t * (segment.t1 - segment.t0), weight);
        if (light_rays_.is_full()) cast();
    }
    void finish(ChunkGrad& grad) {
        cast();
        samples_.finish(grad);
    }

   private:
    void cast() {
        light_rays_.cast([&](const ShadowPoint& point, double weight) {
            if (is_in_view(view_, source_.place_of(point))) samples_.add(point, 0, weight);
        });
    }

    const BackwardView<T>& view_;
    const std::vector<ShadowEdges::Point>& points_;
    ShadowSource<T> source_;
    LightRays<T> light_rays_;
    CurveSamples<Contraction, T, ShadowSource<T>> samples_;
};

}  // namespace

int64_t most_shadow_samples(int64_t width, int64_t height, int spp) {
    return std::clamp(width * height * spp / 8, fewest_samples, most_samples);
}

template <int N, class Contraction, class T>
void add_shadows(const BackwardView<T>& view, const LightPoints& lights, int64_t samples,
                 const Contraction& contraction, Destination& to, BackwardProfile& profile) {
    Stopwatch watch;
    const ShadowEdges edges = ShadowEdgeFinder<T>(view, lights).find(pair_tests);
    const std::vector<Segment> segments = segments_of(view, edges.edges);
    profile.shadow[0] += watch.lap();
    const int64_t count = int64_t(segments.size());
    if (count == 0) return;

    std::vector<Found> found(count);
    const uint64_t pilot_seed = hash(view.options.seed, 10, gradient_stream);
    view.team.each_block(count, [&](int64_t, int64_t first, int64_t last) {
        ChunkGrad unused;
        ShadowChunk chunk(view, lights, edges.points, Pilots(view, lights, found));
        for (int64_t i = first; i < last; ++i) {
            const double shift = to_unit(hash(pilot_seed, i));
            for (int k = 0; k < pilots; ++k) chunk.add(segments[i], i, (k + shift) / pilots, 1);
        }
        chunk.finish(unused);
    });
    // Of the mean border of each light, px.
    std::vector<double> length(lights.lights, 0.0);
    Array<double> measure(count);
    double known = 0, prior = 0;
    for (int64_t i = 0; i < count; ++i) {
        const Segment& s = segments[i];
        measure[i] = s.share() * std::sqrt(found[i].squares / pilots), known += measure[i];
        prior += (s.t1 - s.t0) * s.edge.measure;
        length[s.edge.light] += s.share() * found[i].length / pilots;
    }
    profile.shadow[1] += watch.lap();
    // No more rays than an eighth of the image's, for each is one of a light and one of the camera, alone; and so many
    // where lights have an extent, for each of their points casts a shadow of its own.
    const int64_t most = most_shadow_samples(view.camera.width, view.camera.height, view.image.spp);
    double wanted = 0;
    for (int64_t k = 0; k < lights.lights; ++k)
        wanted += lights.first[k + 1] - lights.first[k] > 1 ? double(most) : samples_a_pixel * length[k];
    for (int64_t i = 0; i < count; ++i)
        measure[i] += floor_share * (known > 0 ? known : 1) * segments[i].edge.measure *
                      (segments[i].t1 - segments[i].t0) / prior;
    const int64_t n = samples >= 0 ? samples : std::clamp(int64_t(std::min(wanted, 1e15)), fewest_samples, most);
    profile.shadow_samples += n;
    if (view.options.dry || n == 0) return;
    Systematic systematic(measure, view.team);
    systematic.draw(n, to_unit(hash(view.options.seed, 11, gradient_stream)));
    double seconds[2] = {0, 0};
    view.scatter.add(n, to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        ShadowChunk chunk(view, lights, edges.points, on_curves<N>(view, contraction, grad));
        int64_t k = -1;
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            k = k < 0 ? systematic.primitive(position) : systematic.primitive(position, k);
            const double fraction =
                std::clamp((position - systematic.begin_of(k)) / systematic.measure_of(k), 0.0, 1.0);
            chunk.add(segments[k], k, fraction, systematic.weight(k) * segments[k].share());
        }
        chunk.finish(grad);
    });
    profile.shadow[2] += seconds[0] + seconds[1];
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N, C, T) \
    template void add_shadows<N, C, T>(const BackwardView<T>&, const LightPoints&, int64_t, const C&, Destination&, BackwardProfile&);
EDGEGRAD_FOR_CONTRACTIONS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
