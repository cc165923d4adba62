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

template <int N, class T>
class BoundaryChunk {
   public:
    BoundaryChunk(const BackwardView<T>& view, ChunkGrad& grad)
        : view_(view), grad_(grad), C_(N ? N : view.scene.channels), adjoint_(RayPacket::size * C_), radiance_(C_) {}

    // The point at the fraction s of the curve.
    void add(const Curve& curve, double s, double weight) {
        const int lane = packet_.count;
        const Vec2 x = curve.position(s);
        if (!view_.adjoint.template at<N>(x, adjoint_.data() + lane * C_)) return;
        lane_[lane] = {curve, x, curve.parameter(s), weight, pixel_ray(view_.camera, x)};
        rejected_[lane] = view_.geometry.topology().faces(curve.edge);
        view_.frame.set(packet_, lane, lane_[lane].ray);
        if (++packet_.count == RayPacket::size) cast();
    }

    void finish() {
        if (packet_.count) cast();
        flush();
    }

   private:
    struct Lane {
        Curve curve;
        Vec2 x;
        double t, weight;
        Ray ray;
    };

    void cast() {
        view_.geometry.caster().cast(packet_, rejected_);
        for (int i = 0; i < packet_.count; ++i) add_sample(lane_[i], packet_.face[i], adjoint_.data() + i * C_);
        packet_.count = 0;
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

    void add_sample(const Lane& lane, int64_t behind, const double* adjoint) {
        const Curve& curve = lane.curve;
        const Vec3 point = (1 - lane.t) * curve.a + lane.t * curve.b;
        Barycentrics b{1.0 / 3, 1.0 / 3};
        if (behind >= 0) {
            const int32_t* v = view_.scene.faces + 3 * behind;
            const auto& q = view_.vertices.q;
            const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
            if (intersect(lane.ray, corner, b)) b = inside(b);
            if (hides(corner, point, curve)) return;
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
        const bool both = current_.minus.face >= 0 && current_.plus.face >= 0;
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

    RayPacket packet_{};
    Lane lane_[RayPacket::size];
    std::span<const int32_t> rejected_[RayPacket::size];
    std::vector<double> adjoint_, radiance_;

    Curve current_;
    Vec3 a_bar_, b_bar_;
};

}  // namespace

template <int N, class T>
int64_t add_boundary(const BackwardView<T>& view, Destination& to) {
    const BackwardOptions& o = view.options;
    const int64_t E = view.geometry.topology().n_edges(), F = view.scene.n_faces;
    std::vector<int8_t> facing(F);
#pragma omp parallel for num_threads(o.threads) schedule(static)
    for (int64_t f = 0; f < F; ++f) {
        const int32_t* v = view.scene.faces + 3 * f;
        facing[f] = int8_t(view.camera.facing(view.vertices.q[v[0]], view.vertices.q[v[1]], view.vertices.q[v[2]]));
    }

    // Curves end to end, by their length in the image times how much the loss looks there.
    std::vector<double> measure(E);
    const int64_t block = 4096, blocks = (E + block - 1) / block;
    std::vector<double> length(blocks, 0.0);
#pragma omp parallel for num_threads(o.threads) schedule(dynamic, 4)
    for (int64_t k = 0; k < blocks; ++k)
        for (int64_t e = k * block; e < std::min(E, (k + 1) * block); ++e) {
            const Curve c = find_curve(view, facing.data(), e);
            if (!(c.length > 0)) continue;
            const double importance = view.importance.mean({std::min(c.x0.x, c.x1.x), std::min(c.x0.y, c.x1.y)},
                                                           {std::max(c.x0.x, c.x1.x), std::max(c.x0.y, c.x1.y)});
            measure[e] = c.length * importance;
            if (importance > 0 && std::isfinite(c.length)) length[k] += c.length;
        }
    double total = 0;
    for (const double l : length) total += l;
    Systematic systematic(measure, o.threads);
    if (!(systematic.total() > 0)) return 0;

    const int64_t n = o.edge_samples >= 0 ? o.edge_samples : int64_t(std::ceil(16 * total));
    systematic.draw(n, to_unit(hash(o.seed, 3)));
    scatter_samples(n, o.threads, to, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        BoundaryChunk<N, T> chunk(view, grad);
        Curve curve;
        int64_t edge = systematic.primitive(systematic.position(first));
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            edge = systematic.primitive(position, edge);
            if (curve.edge != edge) curve = find_curve(view, facing.data(), edge);
            const double s = (position - systematic.begin_of(edge)) / systematic.measure_of(edge);
            chunk.add(curve, std::clamp(s, 0.0, 1.0), systematic.weight(edge));
        }
        chunk.finish();
    });
    return n;
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template int64_t add_boundary<N, float>(const BackwardView<float>&, Destination&); \
    template int64_t add_boundary<N, double>(const BackwardView<double>&, Destination&);
EDGEGRAD_INSTANTIATE(0)
EDGEGRAD_INSTANTIATE(1)
EDGEGRAD_INSTANTIATE(3)
EDGEGRAD_INSTANTIATE(4)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
