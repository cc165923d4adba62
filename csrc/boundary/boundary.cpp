// Curve samples. One ray for each: the radiance of an incident face is known exactly at the edge, so the ray through
// the edge point, blind to the faces of that edge, finds what lies behind, or that something lies before.
//
// Where other curves lie on this one in the image (coincident.h), the ray runs along the rims of their faces, and which
// of these it meets would be left to rounding. So it is blind to them too, and they are asked in double. One that lies
// apart by more than the rounding of doubles covers the point or not; those that do not, coincidence.h puts in order.

#include "boundary/boundary.h"

#include <algorithm>
#include <deque>
#include <limits>
#include <utility>
#include <vector>

#include "boundary/coincidence.h"
#include "boundary/coincident.h"
#include "boundary/crease_control.h"
#include "boundary/crossings.h"
#include "boundary/curve.h"
#include "boundary/curve_measure.h"
#include "core/channels.h"
#include "core/sampler.h"
#include "core/systematic.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

// A set of faces that is emptied at no cost.
class FaceSet {
   public:
    void clear() { ++round_, size_ = 0; }

    // False if it is there already.
    bool insert(int32_t face) {
        if (2 * size_ >= slots_.size()) grow();
        const bool inserted = insert_into(slots_, face);
        size_ += inserted;
        return inserted;
    }

   private:
    struct Slot {
        int32_t face = -1;
        uint32_t round = 0;  // of an earlier one: the slot is free
    };

    bool insert_into(std::vector<Slot>& slots, int32_t face) const {
        for (size_t i = mix(uint64_t(face));; ++i) {
            Slot& slot = slots[i & (slots.size() - 1)];
            if (slot.round == round_ && slot.face == face) return false;
            if (slot.round == round_) continue;
            slot = {face, round_};
            return true;
        }
    }

    void grow() {
        std::vector<Slot> larger(2 * slots_.size());
        for (const Slot& slot : slots_)
            if (slot.round == round_) insert_into(larger, slot.face);
        slots_.swap(larger);
    }

    std::vector<Slot> slots_ = std::vector<Slot>(32);
    size_t size_ = 0;
    uint32_t round_ = 1;
};

template <int N, class T>
class BoundaryChunk {
   public:
    BoundaryChunk(const BackwardView<T>& view, const CurveFinder<T>& finder, const CoincidentCurves& coincident,
                  ChunkGrad& grad)
        : view_(view),
          finder_(finder),
          coincident_(coincident),
          coincidence_(view, finder),
          grad_(grad),
          C_(N ? N : view.scene.channels),
          rays_(view.frame),
          adjoint_(RayBatch::size * C_),
          radiance_(C_) {}

    // The point at the fraction s of the curve.
    void add(const Curve& curve, double s, double weight) {
        const int i = rays_.count;
        const Vec2 x = curve.position(s);
        if (!view_.adjoint.template at<N>(x, adjoint_.data() + i * C_)) return;
        if (places_ == 0 || place_[places_ - 1].own.curve.edge != curve.edge) {
            // A place of which no sample waits, for all were hidden, is free again: so there are never more than lanes.
            if (places_ > 0 && (i == 0 || lane_[i - 1].place != places_ - 1)) --places_;
            start(place_[places_++], curve);
        }
        Place& place = place_[places_ - 1];
        const Vec2 n = normalised(view_.camera, x);
        const double t = curve.parameter(s);
        Lane& lane = lane_[i];
        lane = {.place = places_ - 1,
                .x = x,
                .n = n,
                .t = t,
                .point = (1 - t) * curve.a + t * curve.b,
                .weight = weight,
                .share = {.side = {curve.minus, curve.plus}, .side_t = {t, t}}};
        const std::span<const int32_t> own = view_.geometry.topology().faces(curve.edge);
        blind_[i].clear();
        if ((place.segment || place.edge_on) && !share(place, lane, blind_[i])) return;
        if (!blind_[i].empty()) {
            blind_[i].insert(blind_[i].end(), own.begin(), own.end());
            std::sort(blind_[i].begin(), blind_[i].end());
        }
        rays_.n_x[i] = n.x, rays_.n_y[i] = n.y;
        rejected_[i] = blind_[i].empty() ? own : std::span<const int32_t>(blind_[i]);
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish() {
        cast();
        flush();
        flush_second();
    }

   private:
    // A curve.
    struct Place {
        CoincidentCurve own;          // without its faces until they are asked for
        const ImageSegment* segment;  // where others lie on it somewhere; else null
        bool edge_on, with_faces;     // whether a face of it is seen edge-on; whether `own` has them
    };

    // What lies at a point of the image, behind a curve: a face, or −1 for the background.
    struct Surface {
        int64_t face = -1;
        Barycentrics b;
        double depth = std::numeric_limits<double>::infinity();
    };

    // A sample: the point t of a curve, seen at x.
    struct Lane {
        int place = 0;
        Vec2 x, n;
        double t = 0;
        Vec3 point;
        double weight = 0;
        CoincidentShare share = {};
        Surface behind = {};
    };

    void start(Place& place, const Curve& curve) {
        place.own.curve = curve;
        place.segment = coincident_.find(curve.edge);
        const auto halves = view_.geometry.topology().half_edges(curve.edge);
        place.edge_on =
            std::any_of(halves.begin(), halves.end(), [&](const HalfEdge& h) { return finder_.turn_of(h) == 0; });
        place.with_faces = false;
        other_edges_.clear();
    }

    // Another curve on the line of the latest.
    const CoincidentCurve& other(int64_t edge, const Curve& line) {
        const size_t k = std::find(other_edges_.begin(), other_edges_.end(), edge) - other_edges_.begin();
        if (k < other_edges_.size()) return others_[k];
        other_edges_.push_back(edge);
        if (k == others_.size()) others_.emplace_back();
        Curve c;
        finder_.find(edge, c);
        return others_[k] = coincidence_.on_line(c, line);
    }

    void cast() {
        rays_.prepare();
        view_.geometry.caster().cast(rays_, rejected_);
        for (int i = 0; i < rays_.count; ++i) {
            const Vec2 n = rays_.n(i);
            const int32_t behind = beyond_float(lane_[i], n, rays_.face[i], rejected_[i]);
            add_sample(place_[lane_[i].place].own.curve, lane_[i], behind, adjoint_.data() + i * C_);
        }
        rays_.count = places_ = 0;
    }

    // The face that a ray truly meets, where `face` is what the cast found. Float and double may place the ray on
    // different sides of an edge between two faces that it runs through, and where that edge lies on the curve in the
    // image (the diagonal of a box's front, before an edge of its back) they do so again and again. Then float misses
    // the neighbour that double would meet; so beside the ray that passes through the refused face goes another that is
    // moved off that face by as much as floats may err.
    int32_t beyond_float(const Lane& lane, Vec2 n, int32_t face, std::span<const int32_t> rejected) const {
        const auto decide = [&](int32_t f) { return lies_far_before(view_, f, lane.point.z) || meets(view_, f, n); };
        if (face < 0 || decide(face)) return face;
        std::vector<int32_t> blind(rejected.begin(), rejected.end());
        RayBatch rays(view_.frame);
        int32_t nearest = -1;
        double depth = std::numeric_limits<double>::infinity();
        for (int refused = 0; face >= 0 && !decide(face); ++refused) {
            // Where floats see hundreds of faces in one place, one ray decides on all of them.
            if (refused == most_refused) {
                face = view_.geometry.caster().beyond_float(view_.frame, n, face, blind, decide);
                break;
            }
            const Vec2 beside = moved_off(face, n);
            rays.n_x[0] = n.x, rays.n_y[0] = n.y, rays.n_x[1] = beside.x, rays.n_y[1] = beside.y, rays.count = 2;
            blind.insert(std::upper_bound(blind.begin(), blind.end(), face), face);
            const std::span<const int32_t> all[2] = {blind, blind};
            rays.prepare();
            view_.geometry.caster().cast(rays, all);
            face = rays.face[0];
            if (const int32_t other = rays.face[1]; other >= 0 && decide(other))
                if (const double z = depth_of(view_, other, n); z < depth) nearest = other, depth = z;
        }
        return face >= 0 && depth_of(view_, face, n) < depth ? face : nearest;
    }

    static constexpr int most_refused = 3;

    // n, moved away from a face that does not cover it, across the side that it lies beyond.
    Vec2 moved_off(int64_t face, Vec2 n) const {
        const FaceMap m = face_map(view_.camera, corners_of(view_, face).data());
        const Vec3 p = m.times(n);
        const double sign = p.z < 0 ? -1 : 1;
        // Barycentrics times p.z, as affine functions of n: value and slope.
        const auto row = [&](double Vec3::* r) { return Vec3{m.column[0].*r, m.column[1].*r, p.*r}; };
        const Vec3 u = row(&Vec3::x), v = row(&Vec3::y), w = row(&Vec3::z);
        Vec2 away;
        double farthest = -std::numeric_limits<double>::infinity();
        for (const Vec3 b : {u, v, w - u - v}) {
            const double slope = length(Vec2{b.x, b.y}), distance = -sign * b.z / slope;
            if (slope > 0 && distance > farthest) farthest = distance, away = (-sign / slope) * Vec2{b.x, b.y};
        }
        double error = 0;
        for (int i = 0; i < 3; ++i) {
            const double* q = view_.scene.verts + 3 * int64_t(view_.scene.faces[3 * int64_t(face) + i]);
            error = std::max(error, view_.frame.error({q[0], q[1], q[2]}));
        }
        return n + (2 * error / (view_.camera.perspective ? depth_of(view_, face, n) : 1.0)) * away;
    }

    // Ã · L of a point of a face, or of the background.
    double adjoint_radiance(const Lane& lane, int64_t face, Barycentrics b, const double* adjoint) {
        if (face < 0) return view_.adjoint.template times_background<N>(lane.x);
        shade<N>(view_.scene, face, b, radiance_.data());
        double sum = 0;
        for (int c = 0; c < C_; ++c) sum += adjoint[c] * radiance_[c];
        return sum;
    }

    void add_sample(const Curve& curve, Lane& lane, int32_t hit, const double* adjoint) {
        if (hit >= 0 && !lies_behind(hit, curve, lane)) return;
        CoincidentShare& share = lane.share;
        const Surface& behind = lane.behind;
        // What the ray meets may lie before the others.
        if (share.far_depth > behind.depth) share.side[1 - share.front].face = -1;
        double radiance[2];
        for (int k = 0; k < 2; ++k) {
            const HalfEdge& h = share.side[k];
            radiance[k] = h.face >= 0 ? adjoint_radiance(lane, h.face, at_edge(h, share.side_t[k]), adjoint)
                                      : adjoint_radiance(lane, behind.face, behind.b, adjoint);
        }
        const double scale = lane.weight * share.weight, jump = scale * (radiance[0] - radiance[1]);
        double to_second = 0;
        if (share.halves) {
            to_second = jump / 2;
        } else if (share.second.vertex[0] >= 0 && !(share.uncovered_depth > behind.depth && share.uncovered >= 0)) {
            const double uncovered = share.uncovered >= 0
                                         ? adjoint_radiance(lane, share.uncovered, share.uncovered_b, adjoint)
                                         : adjoint_radiance(lane, behind.face, behind.b, adjoint);
            to_second = scale / 2 * (share.front == 0 ? uncovered - radiance[1] : radiance[0] - uncovered);
        }
        const Vec2 tangent = curve.tangent();
        const auto move = [&](Vec3 point, double jump) {
            Vec3 point_bar;
            project_vjp(view_.camera, point, {jump * tangent.y, -jump * tangent.x}, point_bar, grad_.k);
            return point_bar;
        };
        if (current_.edge != curve.edge) flush(), current_ = curve, a_bar_ = b_bar_ = {};
        const Vec3 point_bar = move(lane.point, jump - to_second);
        a_bar_ += (1 - lane.t) * point_bar;
        b_bar_ += lane.t * point_bar;
        if (to_second == 0) return;
        const EdgePoint& second = share.second;
        if (second.vertex[0] != second_[0] || second.vertex[1] != second_[1]) {
            flush_second();
            for (int i = 0; i < 2; ++i) second_[i] = second.vertex[i], second_bar_[i] = {};
        }
        const Vec3 second_bar = move(second.point, to_second);
        second_bar_[0] += (1 - second.t) * second_bar;
        second_bar_[1] += second.t * second_bar;
    }

    // False if a face that the ray meets hides the point; else it lies behind, and is kept if it is the nearest so far.
    bool lies_behind(int64_t face, const Curve& curve, Lane& lane) const {
        const auto corner = corners_of(view_, face);
        if (lies_far_before(view_, face, lane.point.z) || hides(face, corner.data(), lane.point, curve)) return false;
        const double depth = depth_of(view_, face, lane.n);
        if (depth < lane.behind.depth)
            lane.behind = {face, barycentrics_of_hit(face_map(view_.camera, corner.data()), lane.n), depth};
        return true;
    }

    // What the curves that lie on this one leave to a sample of it; false if nothing. Gathers their faces in `blind`.
    bool share(Place& place, Lane& lane, std::vector<int32_t>& blind) {
        const Curve curve = place.own.curve;
        const Topology& topology = view_.geometry.topology();
        const auto begin = [&] {
            if (!place.with_faces) place.own = coincidence_.on_line(curve, curve), place.with_faces = true;
            coincidence_.start(place.own, lane.x, lane.t);
        };
        bool alone = true, visible = true;
        const auto add = [&](const ImageSegment& o) {
            if (alone) begin(), alone = false;
            const auto faces = topology.faces(o.edge);
            const Vec2 along = o.b - o.a, from = lane.x - o.a;
            const double squared = along.x * along.x + along.y * along.y,
                         s = (from.x * along.x + from.y * along.y) / squared;
            const double apart = std::fabs(wedge(along, from)) / std::sqrt(squared);
            if (apart <= std::max(curve.rounding, o.rounding)) {
                blind.insert(blind.end(), faces.begin(), faces.end());
                if (s < 0 || s > 1) return true;
                const CoincidentCurve& c = other(o.edge, curve);
                return visible = coincidence_.add(c, c.curve.parameter(s));
            }
            for (const int32_t f : faces) {
                if (!asked_.insert(f)) continue;
                blind.push_back(f);
                if (meets(view_, f, lane.n) && !lies_behind(f, curve, lane)) return visible = false;
            }
            return true;
        };
        asked_.clear();
        for (const int32_t f : topology.faces(curve.edge)) asked_.insert(f);
        if (place.segment) coincident_.at(*place.segment, lane.x, add);
        if (!visible) return false;
        if (alone) {
            if (!place.edge_on) return true;
            begin();
        }
        return coincidence_.finish(lane.share);
    }

    // Whether a face that the ray meets lies before the point: its plane has the point on one side and the viewer on
    // the other. Surfaces that touch at the edge (a cube on the ground) are not before it, however flat the view: the
    // point may lie behind the plane by what the rounding of the input leaves, some spacings of the coordinates there,
    // and by what doubles leave of a plane of that size, some of theirs. Faces that share vertices with those of the
    // edge (the front of a thin plate, for its back) are no other surface that touches: the input says how they lie.
    bool hides(int64_t face, const Vec3 corner[3], Vec3 point, const Curve& curve) const {
        const Vec3 normal = cross(corner[1] - corner[0], corner[2] - corner[0]);
        const Vec3 to_viewer = view_.camera.perspective ? -corner[0] : Vec3{0, 0, -1};
        const double viewer = dot(normal, to_viewer), behind = dot(normal, point - corner[0]) * (viewer > 0 ? -1 : 1);
        double size = 0;
        for (int i = 0; i < 3; ++i)
            size = std::max({size, std::fabs(corner[i].x), std::fabs(corner[i].y), std::fabs(corner[i].z)});
        const double apart = behind / length(normal), rounding = rounding_of_doubles * size;
        const HalfEdge& h = curve.minus.face >= 0 ? curve.minus : curve.plus;
        // Of the two meshes, the coarser one's numbers count.
        const Spacing& spacing = *view_.scene.spacing;
        const double coarser =
            std::max(spacing.of(vertex(view_.scene, h, h.first())), spacing.of(view_.scene.faces[3 * face]));
        return apart > rounding &&
               (apart > contact(coarser, largest_coordinate(view_.scene, h), size) || shares_vertex(face, curve.edge));
    }

    bool shares_vertex(int64_t face, int64_t edge) const {
        const int32_t* v = view_.scene.faces + 3 * face;
        for (const int32_t f : view_.geometry.topology().faces(edge))
            for (int i = 0; i < 3; ++i)
                if (std::find(v, v + 3, view_.scene.faces[3 * int64_t(f) + i]) != v + 3) return true;
        return false;
    }

    // The gradient goes to the vertices of the face that ends at the curve; where a face lies on either side, half to
    // each, which matters only if they have copies of their own of the vertices.
    void flush() {
        if (current_.edge < 0) return;
        const bool both = current_.is_crease();
        for (const HalfEdge* h : {&current_.minus, &current_.plus}) {
            if (h->face < 0) continue;
            const Vec3 a = (both ? 0.5 : 1.0) * a_bar_, b = (both ? 0.5 : 1.0) * b_bar_;
            grad_.q.add<3>(vertex(view_.scene, *h, h->first()), &a.x);
            grad_.q.add<3>(vertex(view_.scene, *h, h->second()), &b.x);
        }
        current_.edge = -1;
    }

    void flush_second() {
        for (int i = 0; i < 2; ++i)
            if (second_[i] >= 0) grad_.q.add<3>(second_[i], &second_bar_[i].x);
        second_[0] = second_[1] = -1;
    }

    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    const CoincidentCurves& coincident_;
    Coincidence<T> coincidence_;
    ChunkGrad& grad_;
    const int C_;

    RayBatch rays_;
    Lane lane_[RayBatch::size];
    Place place_[RayBatch::size];  // of the lanes
    int places_ = 0;
    std::vector<int64_t> other_edges_;    // of the curves on the line of the latest
    std::deque<CoincidentCurve> others_;  // theirs; those beyond wait to be used again
    FaceSet asked_;                       // whether the latest sample's ray meets them
    std::vector<int32_t> blind_[RayBatch::size];
    std::span<const int32_t> rejected_[RayBatch::size];
    std::vector<double> adjoint_, radiance_;

    Curve current_;
    Vec3 a_bar_, b_bar_;
    int32_t second_[2] = {-1, -1};  // vertices
    Vec3 second_bar_[2];
};

}  // namespace

template <int N, class T>
void add_boundary(const BackwardView<T>& view, Curves<T>& curves, int64_t n, Destination& to,
                  BackwardProfile& profile) {
    profile.edge_samples = n;
    if (n == 0 || view.options.dry) return;
    Stopwatch watch;
    const CurveFinder<T>& finder = curves.finder;
    Systematic systematic(curves.measure, view.team);
    if (!(systematic.total() > 0)) return;
    systematic.draw(n, to_unit(hash(view.options.seed, 3, gradient_stream)));
    const CoincidentCurves coincident(std::move(curves.segments), systematic, view.team);
    profile.curves += watch.lap();
    if (!curves.x_bar.empty()) to.x = curves.x_bar.data();
    view.scatter.add(n, to, profile.edge, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        BoundaryChunk<N, T> chunk(view, finder, coincident, grad);
        CreaseControl<N, T> control(view);
        Curve curve;
        bool controlled = false;
        int64_t k = systematic.primitive(systematic.position(first));
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            k = systematic.primitive(position, k);
            if (const MeasuredCurve& measured = curves.curve[k]; curve.edge != measured.edge) {
                if (controlled) control.flush(grad.x);
                finder.find(measured.edge, curve);
                controlled = measured.controlled && control.set(curve);
            }
            const double weight = systematic.weight(k);
            const double end = curve.is_crease() ? std::min(Crossings::float_reach / curve.length, 0.1) : 0;
            const double s = std::clamp((position - systematic.begin_of(k)) / systematic.measure_of(k), end, 1 - end);
            if (controlled) control.subtract(s, weight);
            chunk.add(curve, s, weight);
        }
        if (controlled) control.flush(grad.x);
        chunk.finish();
    });
    to.x = nullptr;
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template void add_boundary<N, float>(const BackwardView<float>&, Curves<float>&, int64_t, Destination&, BackwardProfile&); \
    template void add_boundary<N, double>(const BackwardView<double>&, Curves<double>&, int64_t, Destination&, BackwardProfile&);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
