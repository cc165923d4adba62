// Curve samples. One ray for each: the radiance of an incident face is known exactly at the edge, so the ray through
// the edge point, blind to the faces of that edge, finds what lies behind, or that something lies before.

#include "boundary.h"

#include <algorithm>
#include <limits>
#include <vector>

#include "curve.h"
#include "sampler.h"
#include "systematic.h"

namespace edgegrad {

namespace {

// Default samples a pixel of curve; see interior.cpp.
constexpr double samples_per_pixel = 24;

template <int N, class T>
class BoundaryChunk {
   public:
    BoundaryChunk(const BackwardView<T>& view, ChunkGrad& grad)
        : view_(view),
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
        if (curves_ == 0 || curve_[curves_ - 1].edge != curve.edge) curve_[curves_++] = curve;
        const Vec2 n = normalised(view_.camera, x);
        rays_.n_x[i] = n.x, rays_.n_y[i] = n.y;
        lane_[i] = {curves_ - 1, x, curve.parameter(s), weight};
        rejected_[i] = view_.geometry.topology().faces(curve.edge);
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish() {
        cast();
        flush();
    }

   private:
    struct Lane {
        int curve;
        Vec2 x;
        double t, weight;
    };

    void cast() {
        rays_.prepare();
        view_.geometry.caster().cast(rays_, rejected_);
        for (int i = 0; i < rays_.count; ++i) {
            const Vec2 n = rays_.n(i);
            const int32_t behind = view_.geometry.caster().beyond_float(
                view_.frame, n, rays_.face[i], rejected_[i], [&](int32_t face) { return meets(view_, face, n); });
            add_sample(curve_[lane_[i].curve], lane_[i], n, behind, adjoint_.data() + i * C_);
        }
        rays_.count = curves_ = 0;
    }

    // Ã · L, where `known` is next to the curve; else what the ray found, or the background.
    double adjoint_radiance(const Lane& lane, const HalfEdge& known, int64_t behind, Barycentrics b,
                            const double* adjoint) {
        if (known.face < 0 && behind < 0) return view_.adjoint.template times_background<N>(lane.x);
        if (known.face >= 0) shade<N>(view_.scene, known.face, at_edge(known, lane.t), radiance_.data());
        else shade<N>(view_.scene, behind, b, radiance_.data());
        double sum = 0;
        for (int c = 0; c < C_; ++c) sum += adjoint[c] * radiance_[c];
        return sum;
    }

    void add_sample(const Curve& curve, const Lane& lane, Vec2 n, int64_t behind, const double* adjoint) {
        const Vec3 point = (1 - lane.t) * curve.a + lane.t * curve.b;
        Barycentrics b;
        if (behind >= 0) {
            const int32_t* v = view_.scene.faces + 3 * behind;
            const auto& q = view_.vertices.q;
            const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
            if (hides(corner, point, curve)) return;
            b = barycentrics_of_hit(face_map(view_.camera, corner), n);
        }
        const double jump = adjoint_radiance(lane, curve.minus, behind, b, adjoint) -
                            adjoint_radiance(lane, curve.plus, behind, b, adjoint);
        const double scale = lane.weight * jump;
        const Vec2 tangent = curve.tangent();
        Vec3 point_bar;
        project_vjp(view_.camera, point, {scale * tangent.y, -scale * tangent.x}, point_bar, grad_.k);

        if (current_.edge != curve.edge) flush(), current_ = curve, a_bar_ = b_bar_ = {};
        a_bar_ += (1 - lane.t) * point_bar;
        b_bar_ += lane.t * point_bar;
    }

    // Whether a face that the ray meets lies before the point: its plane has the point on one side and the viewer on
    // the other. Surfaces that touch at the edge (a cube on the ground) are not before it, however flat the view: the
    // point may lie behind the plane by what the rounding of the input leaves, some spacings of the coordinates there,
    // and by what doubles leave of a plane of that size, some of theirs.
    bool hides(const Vec3 face[3], Vec3 point, const Curve& curve) const {
        const Vec3 normal = cross(face[1] - face[0], face[2] - face[0]);
        const Vec3 to_viewer = view_.camera.perspective ? -face[0] : Vec3{0, 0, -1};
        const double viewer = dot(normal, to_viewer), behind = dot(normal, point - face[0]) * (viewer > 0 ? -1 : 1);
        const HalfEdge& h = curve.minus.face >= 0 ? curve.minus : curve.plus;
        double coordinate = 0, size = 0;
        for (const int corner : {h.first(), h.second()})
            for (int axis = 0; axis < 3; ++axis)
                coordinate = std::max(coordinate,
                                      std::fabs(view_.scene.verts[3 * int64_t(vertex(view_.scene, h, corner)) + axis]));
        for (int i = 0; i < 3; ++i)
            size = std::max({size, std::fabs(face[i].x), std::fabs(face[i].y), std::fabs(face[i].z)});
        const double rounding =
            8 * view_.options.spacing * coordinate + 64 * std::numeric_limits<double>::epsilon() * size;
        return behind > rounding * length(normal);
    }

    // The gradient goes to the vertices of the face that ends at the curve; where a face lies on either side, half to
    // each, which matters only if they have copies of their own of the vertices.
    void flush() {
        if (current_.edge < 0) return;
        const bool both = current_.is_crease();
        for (const HalfEdge* h : {&current_.minus, &current_.plus}) {
            if (h->face < 0) continue;
            const Vec3 a = (both ? 0.5 : 1.0) * a_bar_, b = (both ? 0.5 : 1.0) * b_bar_;
            grad_.q.add(vertex(view_.scene, *h, h->first()), &a.x);
            grad_.q.add(vertex(view_.scene, *h, h->second()), &b.x);
        }
        current_.edge = -1;
    }

    const BackwardView<T>& view_;
    ChunkGrad& grad_;
    const int C_;

    RayBatch rays_;
    Lane lane_[RayBatch::size];
    Curve curve_[RayBatch::size];  // of the lanes
    int curves_ = 0;
    std::span<const int32_t> rejected_[RayBatch::size];
    std::vector<double> adjoint_, radiance_;

    Curve current_;
    Vec3 a_bar_, b_bar_;
};

}  // namespace

template <int N, class T>
void add_boundary(const BackwardView<T>& view, Destination& to, BackwardProfile& profile) {
    const BackwardOptions& o = view.options;
    const int64_t E = view.geometry.topology().n_edges(), F = view.scene.n_faces;
    Stopwatch watch;
    std::vector<int8_t> facing(F);
    view.team.each_block(F, [&](int64_t, int64_t first, int64_t last) {
        const auto& q = view.vertices.q;
        for (int64_t f = first; f < last; ++f) {
            const int32_t* v = view.scene.faces + 3 * f;
            facing[f] = int8_t(view.camera.facing(q[v[0]], q[v[1]], q[v[2]]));
        }
    });

    // Attributes that are indexed like the vertices are the same on both sides of an edge, unless it joins copies.
    const bool jumps = view.scene.corners != view.scene.faces || view.geometry.topology().welds();

    // Curves end to end, by their length in the image times how much the loss looks there.
    std::vector<double> measure(E);
    struct Found {
        double length = 0;
        int64_t silhouettes = 0, creases = 0;
    };
    std::vector<Found> found(Team::blocks(E));
    view.team.each_block(E, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t e = first; e < last; ++e) {
            Curve c;
            if (!find_curve(view, facing.data(), jumps, e, c)) continue;
            ++(c.is_crease() ? found[k].creases : found[k].silhouettes);
            const double importance = view.importance.mean({std::min(c.x0.x, c.x1.x), std::min(c.x0.y, c.x1.y)},
                                                           {std::max(c.x0.x, c.x1.x), std::max(c.x0.y, c.x1.y)});
            if (!(importance > 0)) continue;
            measure[e] = c.length * importance;
            if (std::isfinite(c.length)) found[k].length += c.length;
        }
    });
    double total = 0;
    for (const Found& f : found) total += f.length, profile.silhouettes += f.silhouettes, profile.creases += f.creases;
    Systematic systematic(measure, view.team);
    profile.curves = watch.lap();
    if (!(systematic.total() > 0)) return;

    const int64_t n = o.edge_samples >= 0 ? o.edge_samples : int64_t(std::ceil(samples_per_pixel * total));
    profile.edge_samples = n;
    if (o.dry) return;
    systematic.draw(n, to_unit(hash(o.seed, 3, gradient_stream)));
    scatter_samples(n, view.team, to, profile.edge, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        BoundaryChunk<N, T> chunk(view, grad);
        Curve curve;
        int64_t edge = systematic.primitive(systematic.position(first));
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            edge = systematic.primitive(position, edge);
            if (curve.edge != edge) find_curve(view, facing.data(), jumps, edge, curve);
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
EDGEGRAD_INSTANTIATE(0)
EDGEGRAD_INSTANTIATE(1)
EDGEGRAD_INSTANTIATE(3)
EDGEGRAD_INSTANTIATE(4)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
