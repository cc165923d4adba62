// Curve samples. One ray for each: the radiance of an incident face is known exactly at the edge, so the ray through
// the edge point, blind to the faces of that edge, finds what lies behind, or that something lies before.
//
// Where other curves lie on this one in the image (coincident.h), the ray runs along the rims of their faces, and which
// of these it meets would be left to rounding. So it is blind to them too, and they are asked in double. One that lies
// apart by more than the rounding of doubles covers the point or not. One that does not covers one side of it:
//
//  - at the same depth (a box on a box), its faces and those of this curve are taken for the faces of one edge, of
//    which each curve moves its share;
//  - before or behind (the back edge of a box that is seen straight on), the sample is the mean of two: one sees what
//    lies before on one side of the curve and what lies behind on the other, one the reverse.
//
// Along the order of depth the jumps then add up to what is seen on one side minus what is seen on the other, so that a
// motion that all share has its true derivative. One that parts them has another derivative for each direction.

#include "boundary.h"

#include <algorithm>
#include <limits>
#include <vector>

#include "coincident.h"
#include "curve.h"
#include "sampler.h"
#include "systematic.h"

namespace edgegrad {

namespace {

// Default samples a pixel of curve; see surface_measure.cpp.
constexpr double samples_per_pixel = 24;

template <int N, class T>
class BoundaryChunk {
   public:
    BoundaryChunk(const BackwardView<T>& view, const CurveFinder<T>& finder, const CoincidentCurves& coincident,
                  ChunkGrad& grad)
        : view_(view),
          finder_(finder),
          coincident_(coincident),
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
        if (places_ == 0 || place_[places_ - 1].curve.edge != curve.edge) {
            // A place of which no sample waits, for all were hidden, is free again: so there are never more than lanes.
            if (places_ > 0 && (i == 0 || lane_[i - 1].place != places_ - 1)) --places_;
            start(place_[places_++], curve);
        }
        const Place& place = place_[places_ - 1];
        const Vec2 n = normalised(view_.camera, x);
        const double t = curve.parameter(s);
        Lane& lane = lane_[i];
        lane = {.place = places_ - 1,
                .x = x,
                .n = n,
                .t = t,
                .point = (1 - t) * curve.a + t * curve.b,
                .weight = weight,
                .side = {{curve.minus, t}, {curve.plus, t}},
                .views = place.others.empty() ? 1 : 2};
        for (const Curve& other : place.others) {
            add_other(other, curve, lane);
            if (!lane.is_seen()) return;
        }
        rays_.n_x[i] = n.x, rays_.n_y[i] = n.y;
        rejected_[i] =
            place.others.empty() ? view_.geometry.topology().faces(curve.edge) : std::span<const int32_t>(place.blind);
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish() {
        cast();
        flush();
    }

   private:
    // A curve, and those that lie on it.
    struct Place {
        Curve curve;
        std::vector<Curve> others;
        std::vector<int32_t> blind;  // faces of all of them
    };

    // What lies at a point of the image, behind a curve: a face, or −1 for the background.
    struct Surface {
        int64_t face = -1;
        Barycentrics b;
        double depth = std::numeric_limits<double>::infinity();
    };

    // What is seen next to a curve: a face that ends there, or, with none, what lies behind.
    struct Side {
        HalfEdge face;
        double t = 0;  // on its edge
    };

    // A sample: the point t of a curve, seen at x.
    struct Lane {
        int place = 0;
        Vec2 x, n;
        double t = 0;
        Vec3 point;
        double weight = 0;
        Side side[2];   // minus, plus
        int share = 1;  // curves that move together here
        int views = 1;  // two where other curves lie before or behind, each of which covers one side of the point
        bool hidden[2] = {};
        Surface behind[2];

        bool is_seen() const { return !hidden[0] || (views == 2 && !hidden[1]); }
    };

    void start(Place& place, const Curve& curve) {
        place.curve = curve;
        place.others.clear(), place.blind.clear();
        if (coincident_.empty()) return;
        const Topology& topology = view_.geometry.topology();
        const auto blind_to = [&](int64_t edge) {
            for (const int32_t f : topology.faces(edge)) place.blind.push_back(f);
        };
        for (const int64_t edge : coincident_.of(curve.edge))
            if (Curve c; finder_.find(edge, c)) place.others.push_back(c), blind_to(edge);
        if (place.others.empty()) return;
        blind_to(curve.edge);
        std::sort(place.blind.begin(), place.blind.end());
    }

    void cast() {
        rays_.prepare();
        view_.geometry.caster().cast(rays_, rejected_);
        for (int i = 0; i < rays_.count; ++i) {
            const Vec2 n = rays_.n(i);
            const auto decide = [&](int32_t face) {
                return lies_far_before(view_, face, lane_[i].point.z) || meets(view_, face, n);
            };
            const int32_t behind =
                view_.geometry.caster().beyond_float(view_.frame, n, rays_.face[i], rejected_[i], decide);
            add_sample(place_[lane_[i].place], lane_[i], behind, adjoint_.data() + i * C_);
        }
        rays_.count = places_ = 0;
    }

    // Ã · L of what is seen on one side.
    double adjoint_radiance(const Lane& lane, const Side& side, const Surface& behind, const double* adjoint) {
        if (side.face.face < 0 && behind.face < 0) return view_.adjoint.template times_background<N>(lane.x);
        if (side.face.face >= 0) shade<N>(view_.scene, side.face.face, at_edge(side.face, side.t), radiance_.data());
        else shade<N>(view_.scene, behind.face, behind.b, radiance_.data());
        double sum = 0;
        for (int c = 0; c < C_; ++c) sum += adjoint[c] * radiance_[c];
        return sum;
    }

    void add_sample(const Place& place, Lane& lane, int32_t hit, const double* adjoint) {
        const Curve& curve = place.curve;
        if (hit >= 0 && !lies_behind(hit, curve, lane)) return;
        double jump = 0;
        for (int k = 0; k < lane.views; ++k)
            if (!lane.hidden[k])
                jump += adjoint_radiance(lane, lane.side[0], lane.behind[k], adjoint) -
                        adjoint_radiance(lane, lane.side[1], lane.behind[k], adjoint);
        const double scale = lane.weight * jump / (lane.views * lane.share);
        const Vec2 tangent = curve.tangent();
        Vec3 point_bar;
        project_vjp(view_.camera, lane.point, {scale * tangent.y, -scale * tangent.x}, point_bar, grad_.k);

        if (current_.edge != curve.edge) flush(), current_ = curve, a_bar_ = b_bar_ = {};
        a_bar_ += (1 - lane.t) * point_bar;
        b_bar_ += lane.t * point_bar;
    }

    // False if a face that the ray meets hides the point; else it lies behind, and is kept if it is the nearest so far.
    bool lies_behind(int64_t face, const Curve& curve, Lane& lane) const {
        const auto corner = corners_of(view_, face);
        if (lies_far_before(view_, face, lane.point.z) || hides(face, corner.data(), lane.point, curve)) return false;
        const double depth = depth_of(view_, face, lane.n);
        for (int k = 0; k < lane.views; ++k)
            if (depth < lane.behind[k].depth)
                lane.behind[k] = {face, barycentrics_of_hit(face_map(view_.camera, corner.data()), lane.n), depth};
        return true;
    }

    // What a curve that lies on this one does to a sample of it.
    void add_other(const Curve& other, const Curve& curve, Lane& lane) const {
        const Vec2 along = other.tangent(), from = lane.x - other.x0;
        const double squared = along.x * along.x + along.y * along.y,
                     s = (from.x * along.x + from.y * along.y) / squared;
        const double apart = std::fabs(wedge(along, from)) / std::sqrt(squared);
        if (!(apart <= std::max(curve.rounding, other.rounding))) {
            const auto own = view_.geometry.topology().faces(curve.edge);
            for (const int32_t f : view_.geometry.topology().faces(other.edge))
                if (std::find(own.begin(), own.end(), f) == own.end() && meets(view_, f, lane.n) &&
                    !lies_behind(f, curve, lane))
                    lane.hidden[0] = lane.hidden[1] = true;
            return;
        }
        if (s < 0 || s > 1) return;
        const double t = other.parameter(s), depth = (1 - t) * other.a.z + t * other.b.z;
        const bool opposite = along.x * curve.tangent().x + along.y * curve.tangent().y < 0;
        const HalfEdge* half[2] = {opposite ? &other.plus : &other.minus, opposite ? &other.minus : &other.plus};
        if (std::fabs(depth - lane.point.z) <=
            contact(curve, std::max(std::fabs(depth), length(lane.point)), a_face(other))) {
            ++lane.share;
            for (int k = 0; k < 2; ++k)
                if (Side& side = lane.side[k];
                    half[k]->face >= 0 &&
                    (side.face.face < 0 || !in_front(view_, side.face, *half[k], curve.a, curve.b)))
                    side = {*half[k], t};
            return;
        }
        for (int k = 0; k < 2; ++k)
            if (depth < lane.point.z) lane.hidden[k] |= half[k]->face >= 0;
            else if (const HalfEdge& covers = *half[!k]; covers.face >= 0 && depth < lane.behind[k].depth)
                lane.behind[k] = {covers.face, at_edge(covers, t), depth};
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
        return apart > rounding && (apart > contact(curve, size, face) || shares_vertex(face, curve.edge));
    }

    bool shares_vertex(int64_t face, int64_t edge) const {
        const int32_t* v = view_.scene.faces + 3 * face;
        for (const int32_t f : view_.geometry.topology().faces(edge))
            for (int i = 0; i < 3; ++i)
                if (std::find(v, v + 3, view_.scene.faces[3 * int64_t(f) + i]) != v + 3) return true;
        return false;
    }

    static int64_t a_face(const Curve& c) { return c.minus.face >= 0 ? c.minus.face : c.plus.face; }

    // World units by which a face that touches at the curve may lie apart, for the rounding of the input, of which that
    // of the coarser mesh counts, and of doubles.
    static constexpr double rounding_of_doubles = 64 * std::numeric_limits<double>::epsilon();
    double contact(const Curve& curve, double size, int64_t face) const {
        const HalfEdge& h = curve.minus.face >= 0 ? curve.minus : curve.plus;
        double coordinate = 0;
        for (const int corner : {h.first(), h.second()})
            for (int axis = 0; axis < 3; ++axis)
                coordinate = std::max(coordinate,
                                      std::fabs(view_.scene.verts[3 * int64_t(vertex(view_.scene, h, corner)) + axis]));
        const Spacing& spacing = view_.options.spacing;
        return 8 * std::max(spacing.of(vertex(view_.scene, h, h.first())), spacing.of(view_.scene.faces[3 * face])) *
                   coordinate +
               rounding_of_doubles * size;
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

    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    const CoincidentCurves& coincident_;
    ChunkGrad& grad_;
    const int C_;

    RayBatch rays_;
    Lane lane_[RayBatch::size];
    Place place_[RayBatch::size];  // of the lanes
    int places_ = 0;
    std::span<const int32_t> rejected_[RayBatch::size];
    std::vector<double> adjoint_, radiance_;

    Curve current_;
    Vec3 a_bar_, b_bar_;
};

// How far, in pixels, a ray may miss the points of a curve. A hundredth where it would be more: by then the image shows
// floats, not faces.
template <class T>
double reach_of_rays(const BackwardView<T>& view, const Curve& c) {
    double error = 0;
    const HalfEdge& h = c.minus.face >= 0 ? c.minus : c.plus;
    for (const int corner : {h.first(), h.second()}) {
        const double* p = view.scene.verts + 3 * int64_t(vertex(view.scene, h, corner));
        error = std::max(error, view.frame.error({p[0], p[1], p[2]}));
    }
    return std::max(c.rounding, std::min(view.camera.pixels_per_unit / std::min(c.w0, c.w1) * error, 0.01));
}

}  // namespace

template <int N, class T>
void add_boundary(const BackwardView<T>& view, Destination& to, BackwardProfile& profile) {
    const BackwardOptions& o = view.options;
    const int64_t E = view.geometry.topology().n_edges();
    Stopwatch watch;
    const CurveFinder<T> finder(view);

    // Curves end to end, by their length in the image times how much the loss looks there.
    Array<double> measure(E);
    struct Found {
        double length = 0;
        int64_t silhouettes = 0, creases = 0;
        std::vector<ImageSegment> segments;
    };
    std::vector<Found> found(Team::blocks(E));
    view.team.each_block(E, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t e = first; e < last; ++e) {
            Curve c;
            measure[e] = 0;
            if (!finder.find(e, c)) continue;
            ++(c.is_crease() ? found[k].creases : found[k].silhouettes);
            const double importance = view.importance.mean({std::min(c.x0.x, c.x1.x), std::min(c.x0.y, c.x1.y)},
                                                           {std::max(c.x0.x, c.x1.x), std::max(c.x0.y, c.x1.y)});
            if (!(importance > 0)) continue;
            measure[e] = c.length * importance;
            if (!std::isfinite(c.length)) continue;
            found[k].length += c.length;
            found[k].segments.push_back({e, c.x0, c.x1, reach_of_rays(view, c)});
        }
    });
    double total = 0;
    std::vector<ImageSegment> segments;
    for (const Found& f : found) {
        total += f.length, profile.silhouettes += f.silhouettes, profile.creases += f.creases;
        segments.insert(segments.end(), f.segments.begin(), f.segments.end());
    }
    const CoincidentCurves coincident(segments, view.team);
    Systematic systematic(measure, view.team);
    profile.curves = watch.lap();
    if (!(systematic.total() > 0)) return;

    const int64_t n = o.edge_samples >= 0 ? o.edge_samples : int64_t(std::ceil(samples_per_pixel * total));
    profile.edge_samples = n;
    if (o.dry) return;
    systematic.draw(n, to_unit(hash(o.seed, 3, gradient_stream)));
    view.scatter.add(n, to, profile.edge, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        BoundaryChunk<N, T> chunk(view, finder, coincident, grad);
        Curve curve;
        int64_t edge = systematic.primitive(systematic.position(first));
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            edge = systematic.primitive(position, edge);
            if (curve.edge != edge) finder.find(edge, curve);
            const double s = (position - systematic.begin_of(edge)) / systematic.measure_of(edge);
            chunk.add(curve, std::clamp(s, 0.0, 1.0), systematic.weight(edge));
        }
        chunk.finish();
    });
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template void add_boundary<N, float>(const BackwardView<float>&, Destination&, BackwardProfile&); \
    template void add_boundary<N, double>(const BackwardView<double>&, Destination&, BackwardProfile&);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
