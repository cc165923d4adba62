// This file holds the curve source of silhouettes, open borders and creases.
//
// An edge (a, b) contributes ∫ Ã (L₋ − L₊) (δx ∧ τ) ds to ∂loss/∂Φ, with τ = dx/ds. The point at the fraction s of its
// image is p = (1 − t) a + t b. It moves by δx = ∂x/∂p ((1 − t) δa + t δb) + ∂x/∂K δK in the image.
//
// The radiance of an incident face is known exactly at the edge. The ray through the edge point ignores the faces of
// that edge, and finds what lies behind or occludes it.
//
// Where other curves coincide with this one in the image (coincident_segments.h), the ray runs along the borders of
// their faces. Rounding would decide which of these it meets, so they are tested in double precision. A face whose
// curve is more than the rounding of doubles away, or meets this one at an angle, covers the point or not. The ray
// ignores the faces that do. It also ignores faces of curves on the same line, which coincidence.h orders.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <deque>
#include <span>
#include <vector>

#include "boundary/curve.h"
#include "boundary/curve_source.h"
#include "boundary/visibility.h"
#include "primary/coincidence.h"
#include "primary/coincident_segments.h"
#include "primary/face_set.h"

namespace edgegrad {

template <class T>
class EdgeSource {
   public:
    using Curve = edgegrad::Curve;

    // A Sample is the point t of an edge.
    struct Sample : CurveSample {
        int pending_curve = 0;
        double t = 0;
        CoincidentShare share = {};
    };

    EdgeSource(const BackwardView<T>& view, const CurveFinder<T>& finder, const CoincidentCurves& coincident)
        : view_(view), finder_(finder), visibility_(view), coincident_(coincident), coincidence_(view, finder) {}

    Vec2 position(const Curve& curve, double s) const { return curve.position(s); }

    bool place(const Curve& curve, double s, Sample& sample) {
        if (n_pending_ == 0 || pending_[n_pending_ - 1].own.curve.edge != curve.edge) {
            // A curve without a pending sample is replaced, so there are never more curves than lanes.
            if (n_pending_ > 0 && latest_ != n_pending_ - 1) --n_pending_;
            start(pending_[n_pending_++], curve);
        }
        PendingCurve& pending = pending_[n_pending_ - 1];
        const double t = curve.parameter(s);
        sample.pending_curve = n_pending_ - 1;
        sample.point = (1 - t) * curve.a + t * curve.b;
        sample.t = t;
        sample.behind = {};
        sample.share = {.side = {curve.minus, curve.plus}, .side_t = {t, t}};
        if (view_.alpha_masks && !show(curve, t, sample.share)) return false;
        const std::span<const int32_t> own = pending.faces.faces;
        sample.gathered.clear();
        if ((pending.segment || pending.edge_on) && !share(pending, sample)) return false;
        if (!sample.gathered.empty()) {
            sample.gathered.insert(sample.gathered.end(), own.begin(), own.end());
            std::sort(sample.gathered.begin(), sample.gathered.end());
        }
        sample.ignored = sample.gathered.empty() ? own : std::span<const int32_t>(sample.gathered);
        latest_ = sample.pending_curve;
        return true;
    }

    const CurveFaces& faces_of(const Sample& sample) const { return pending_[sample.pending_curve].faces; }

    SampleSurfaces surfaces(Sample& sample) const {
        CoincidentShare& share = sample.share;
        const SurfacePoint& behind = sample.behind;
        // The surface that the ray meets may lie before the others.
        if (share.far_depth > behind.depth) share.side[1 - share.front].face = -1;
        SampleSurfaces surfaces;
        for (int k = 0; k < 2; ++k) {
            const HalfEdge& h = share.side[k];
            surfaces.at[k] = h.face >= 0 ? SurfacePoint{h.face, next_to_edge(view_.scene, h, share.side_t[k])} : behind;
        }
        if (uncovers(sample))
            surfaces.at[surfaces.count++] =
                share.uncovered >= 0 ? SurfacePoint{share.uncovered, share.uncovered_b} : behind;
        return surfaces;
    }

    CurveJumps jumps(const Sample& sample, const double* radiance) const {
        const CoincidentShare& share = sample.share;
        const double scale = sample.weight * share.weight, jump = scale * (radiance[0] - radiance[1]);
        double to_second = 0;
        if (share.halves) to_second = jump / 2;
        else if (uncovers(sample))
            to_second = scale / 2 * (share.front == 0 ? radiance[2] - radiance[1] : radiance[0] - radiance[2]);
        return {jump - to_second, to_second};
    }

    // δx ∧ τ = δx · (τ_y, −τ_x).
    Vec2 normal(const Sample& sample) const {
        const Vec2 tangent = distorted_tangent(sample);
        return {tangent.y, -tangent.x};
    }

    // Returns δx ∧ τ of the point. The vertices of the faces on either side have equal parts, as in flush().
    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const Curve& curve = pending_[sample.pending_curve].own.curve;
        const Vec2 tangent = distorted_tangent(sample);
        const auto velocity = [&](Vec3 point, Vec3 point_dot) {
            return wedge(project_jvp(view_.camera, point, point_dot, direction.intrinsics), tangent);
        };
        Vec3 point_dot;
        for (const HalfEdge* h : {&curve.minus, &curve.plus}) {
            if (h->face < 0) continue;
            const double half = curve.is_crease() ? 0.5 : 1;
            point_dot += half * ((1 - sample.t) * direction.q[vertex(view_.scene, *h, h->first())] +
                                 sample.t * direction.q[vertex(view_.scene, *h, h->second())]);
        }
        const EdgePoint& second = sample.share.second;
        const double of_second = second.vertex[0] >= 0 && second.vertex[1] >= 0
                                     ? velocity(second.point, (1 - second.t) * direction.q[second.vertex[0]] +
                                                                  second.t * direction.q[second.vertex[1]])
                                     : 0;
        return {velocity(sample.point, point_dot), of_second};
    }

    void add_motion(const Sample& sample, CurveJumps jumps, LocalGradients& grad) {
        const Curve& curve = pending_[sample.pending_curve].own.curve;
        const CoincidentShare& share = sample.share;
        const Vec2 tangent = distorted_tangent(sample);
        const auto move = [&](Vec3 point, double jump) {
            Vec3 point_bar;
            project_vjp(view_.camera, point, {jump * tangent.y, -jump * tangent.x}, point_bar, grad.k);
            return point_bar;
        };
        if (current_.edge != curve.edge) flush(grad), current_ = curve, a_bar_ = b_bar_ = {};
        const Vec3 point_bar = move(sample.point, jumps.first);
        a_bar_ += (1 - sample.t) * point_bar;
        b_bar_ += sample.t * point_bar;
        if (jumps.second == 0) return;
        const EdgePoint& second = share.second;
        if (second.vertex[0] != second_[0] || second.vertex[1] != second_[1]) {
            flush_second(grad);
            for (int i = 0; i < 2; ++i) second_[i] = second.vertex[i], second_bar_[i] = {};
        }
        const Vec3 second_bar = move(second.point, jumps.second);
        second_bar_[0] += (1 - second.t) * second_bar;
        second_bar_[1] += second.t * second_bar;
    }

    void cast() { n_pending_ = 0, latest_ = -1; }

    void finish(LocalGradients& grad) {
        flush(grad);
        flush_second(grad);
    }

   private:
    // A PendingCurve is a curve with pending samples.
    struct PendingCurve {
        CoincidentCurve own;          // without its faces until they are needed
        const ImageSegment* segment;  // segment, if others lie on it somewhere; else null
        bool edge_on, with_faces;     // whether a face of it is seen edge-on; whether `own` has its faces
        CurveFaces faces;
    };

    void start(PendingCurve& pending, const Curve& curve) {
        const Topology& topology = view_.geometry.topology();
        pending.own.curve = curve;
        pending.segment = coincident_.find(curve.edge);
        const auto halves = topology.half_edges(curve.edge);
        pending.edge_on =
            std::any_of(halves.begin(), halves.end(), [&](const HalfEdge& h) { return finder_.facing_of(h) == 0; });
        pending.with_faces = false;
        const HalfEdge& h = curve.minus.face >= 0 ? curve.minus : curve.plus;
        pending.faces = {topology.faces(curve.edge), largest_coordinate(view_.scene, h),
                         view_.scene.spacing->of(vertex(view_.scene, h, h.first()))};
        other_edges_.clear();
    }

    // Sets the opaque faces on either side of the point t, if any may be alpha-tested. Returns false if there are none.
    bool show(const Curve& curve, double t, CoincidentShare& share) const {
        share.side[0].face = share.side[1].face = -1;
        for (const HalfEdge& h : view_.geometry.topology().half_edges(curve.edge)) {
            const int facing = finder_.facing_of(h);
            if (facing == 0 || !shows(view_.scene, h.face, next_to_edge(view_.scene, h, t))) continue;
            HalfEdge& side = share.side[facing > 0 ? 0 : 1];
            if (side.face < 0 || !in_front(view_, side, h, curve.a, curve.b)) side = h;
        }
        return share.side[0].face >= 0 || share.side[1].face >= 0;
    }

    // Returns another curve on the line of the latest.
    const CoincidentCurve& other(int64_t edge, const Curve& line) {
        const size_t k = std::find(other_edges_.begin(), other_edges_.end(), edge) - other_edges_.begin();
        if (k < other_edges_.size()) return others_[k];
        other_edges_.push_back(edge);
        if (k == others_.size()) others_.emplace_back();
        Curve c;
        finder_.find(edge, c);
        return others_[k] = coincidence_.on_line(c, line);
    }

    // Returns dx/ds at the pixel position.
    Vec2 distorted_tangent(const Sample& sample) const {
        return distort_jvp(view_.camera, sample.n, pending_[sample.pending_curve].own.curve.tangent());
    }

    // Computes what coincident curves leave to a sample, and gathers their faces. Returns false if it is nothing.
    bool share(PendingCurve& pending, Sample& sample) {
        const Curve curve = pending.own.curve;
        const Topology& topology = view_.geometry.topology();
        std::vector<int32_t>& ignored = sample.gathered;
        const auto begin = [&] {
            if (!pending.with_faces) pending.own = coincidence_.on_line(curve, curve), pending.with_faces = true;
            coincidence_.start(pending.own, sample.u, sample.t);
        };
        bool alone = true, visible = true;
        const auto add = [&](const ImageSegment& o, CoincidentCurves::Overlap overlap) {
            const bool on_line = overlap == CoincidentCurves::Overlap::along;
            if (alone && on_line) begin(), alone = false;
            const auto faces = topology.faces(o.edge);
            const Vec2 along = o.b - o.a, from = sample.u - o.a;
            const double squared = along.x * along.x + along.y * along.y,
                         s = (from.x * along.x + from.y * along.y) / squared;
            const double apart = std::fabs(wedge(along, from)) / std::sqrt(squared);
            if (on_line && apart <= std::max(curve.rounding, o.rounding)) {
                ignored.insert(ignored.end(), faces.begin(), faces.end());
                if (s < 0 || s > 1) return true;
                const CoincidentCurve& c = other(o.edge, curve);
                CoincidentShare there;
                if (view_.alpha_masks && !show(c.curve, c.curve.parameter(s), there)) return true;
                return visible = coincidence_.add(c, c.curve.parameter(s));
            }
            for (const int32_t f : faces) {
                // A face that the ray misses is not ignored. If single precision confuses it with a neighbour, the ray
                // finds that one as well (Visibility::exact_hit).
                if (!tested_.insert(f) || !meets(view_, f, sample.n)) continue;
                ignored.push_back(f);
                if (!visibility_.lies_behind(f, pending.faces, sample)) return visible = false;
            }
            return true;
        };
        tested_.clear();
        for (const int32_t f : pending.faces.faces) tested_.insert(f);
        if (pending.segment) coincident_.at(*pending.segment, sample.u, add);
        if (!visible) return false;
        if (alone) {
            if (!pending.edge_on) return true;
            begin();
        }
        return coincidence_.finish(sample.share);
    }

    // Returns whether a second curve gets a part of the jump that depends on what this one uncovers.
    static bool uncovers(const Sample& sample) {
        const CoincidentShare& share = sample.share;
        return !share.halves && share.second.vertex[0] >= 0 &&
               !(share.uncovered_depth > sample.behind.depth && share.uncovered >= 0);
    }

    // Adds the gradient to the vertices of the face that ends at the curve. Where a face lies on either side, each gets
    // half. This matters only if they have copies of the vertices.
    void flush(LocalGradients& grad) {
        if (current_.edge < 0) return;
        const bool both = current_.is_crease();
        for (const HalfEdge* h : {&current_.minus, &current_.plus}) {
            if (h->face < 0) continue;
            const Vec3 a = (both ? 0.5 : 1.0) * a_bar_, b = (both ? 0.5 : 1.0) * b_bar_;
            grad.q.add<3>(vertex(view_.scene, *h, h->first()), &a.x);
            grad.q.add<3>(vertex(view_.scene, *h, h->second()), &b.x);
        }
        current_.edge = -1;
    }

    void flush_second(LocalGradients& grad) {
        for (int i = 0; i < 2; ++i)
            if (second_[i] >= 0) grad.q.add<3>(second_[i], &second_bar_[i].x);
        second_[0] = second_[1] = -1;
    }

    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    const Visibility<T> visibility_;
    const CoincidentCurves& coincident_;
    Coincidence<T> coincidence_;

    PendingCurve pending_[RayBatch::size];  // curves of the pending samples
    int n_pending_ = 0, latest_ = -1;       // their number; index of the latest sample's
    std::vector<int64_t> other_edges_;      // edges of the curves on the line of the latest curve
    std::deque<CoincidentCurve> others_;    // their curves; entries beyond are kept for reuse
    FaceSet tested_;                        // faces that were tested against the latest sample's ray

    // The members below sum over the latest curve, and over the latest second curve.
    Curve current_;
    Vec3 a_bar_, b_bar_;
    int32_t second_[2] = {-1, -1};  // vertices
    Vec3 second_bar_[2];
};

}  // namespace edgegrad
