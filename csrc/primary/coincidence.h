// This file decides, point by point, which of several curves on one line in the image gets the gradient.
//
// Of all faces that end at a point of the line, one lies in front. Say it is on the minus side, and call its curve the
// front curve. L₋ is its radiance. L₊ is what the other side shows: the front-most face that ends there, or the
// background behind. If the front curve moves alone towards plus, its face grows over L₊. Towards minus it uncovers L₀,
// what is next on its own side. These are two one-sided derivatives, and the gradient is their mean:
//
//     front: L₋ − (L₀ + L₊) / 2,   the curve of what it uncovers: (L₀ − L₊) / 2,   all others: 0.
//
// The sum is the jump L₋ − L₊, so a motion that all curves share has its true derivative. Each part lies between its
// curve's one-sided derivatives. The second curve, drawn back, changes nothing, because the front face covers it; drawn
// forward it shows L₀ over L₊. Curves farther behind change nothing when they are drawn back.
//
// The front curve's samples suffice. Samples of the others stop here, before any ray is cast.
//
// The front curve may uncover one of its own faces, seen edge-on, as the side of a box. The second curve is then the
// side on which the ray leaves that face. Four cases are special:
//
//  - Faces of the front curve end on both sides: it takes the whole jump, because nothing else shows when it moves.
//  - The front faces of both sides touch, on curves of their own (two roofs, a T-junction). Each covers half of the
//    strip that both sweep, so each is the front one with weight ½ and the other is the second curve. Let U be what a
//    curve uncovers. The one on minus then gets (L₋ − U₋) / 2 + (L₋ − L₊) / 4, the mean of its own derivatives, plus
//    (U₋ − U₊) / 4. The one on plus gets the mirrored sum.
//  - Another face ends on the other side, before the uncovered one. No other curve may then have a part, and the front
//    one takes the whole jump, its derivative where its face grows. If the two curves are alone, each gets the mean of
//    its own.
//  - The front curve is the far side of a face seen edge-on, which shows whichever side moves: each gets half.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "boundary/curve.h"
#include "scene/contact.h"

namespace edgegrad {

// Returns the largest world coordinate of the ends of an edge.
template <class T>
double largest_coordinate(const SceneView<T>& scene, const HalfEdge& h) {
    double largest = 0;
    for (const int corner : {h.first(), h.second()})
        for (int axis = 0; axis < 3; ++axis)
            largest = std::max(largest, std::fabs(scene.verts[3 * int64_t(vertex(scene, h, corner)) + axis]));
    return largest;
}

// An EdgePoint is a point on a side of a face: the side's vertices, and the position between them.
struct EdgePoint {
    int32_t vertex[2] = {-1, -1};
    double t = 0;
    Vec3 point;  // camera coordinates
};

// A CoincidentCurve is a curve with its faces next to the line of another curve.
struct CoincidentCurve {
    Curve curve;
    HalfEdge side[2] = {};               // faces that end on the minus and plus side of the line; face −1: none
    std::vector<HalfEdge> edge_on = {};  // faces that lie on the line
    double coordinate = 0, spacing = 0;  // largest coordinate of its ends, and the spacing of the input's numbers
};

// CoincidentShare is what a sample of a curve stands for.
struct CoincidentShare {
    HalfEdge side[2] = {};  // faces seen on minus and plus; face −1: what lies behind
    double side_t[2] = {};
    double far_depth = -std::numeric_limits<double>::infinity();  // depth of another curve's face, on the opposite side
    double weight = 1;
    int front = 0;  // side on which the curve's own face ends

    // The members below describe the second curve and what the front one uncovers: a face, or what lies behind.
    EdgePoint second = {};  // no vertices: there is no second curve
    bool halves = false;    // whether the second curve gets half of the jump
    int32_t uncovered = -1;
    Barycentrics uncovered_b = {};
    double uncovered_depth = std::numeric_limits<double>::infinity();
};

template <class T>
class Coincidence {
   public:
    Coincidence(const BackwardView<T>& view, const CurveFinder<T>& finder) : view_(view), finder_(finder) {}

    // Returns `curve` with its faces next to the line of `line`.
    CoincidentCurve on_line(const Curve& curve, const Curve& line) const {
        CoincidentCurve c{.curve = curve};
        c.side[0].face = c.side[1].face = -1;
        const Vec2 along = line.tangent();
        const bool opposite = along.x * curve.tangent().x + along.y * curve.tangent().y < 0;
        for (const HalfEdge& h : view_.geometry.topology().half_edges(curve.edge)) {
            const int facing = lies_on(h, curve) ? 0 : finder_.facing_of(h);
            if (facing == 0) {
                c.edge_on.push_back(h);
                continue;
            }
            HalfEdge& end = c.side[(facing > 0) == opposite];
            if (end.face < 0 || !in_front(view_, end, h, curve.a, curve.b)) end = h;
        }
        const HalfEdge& h = view_.geometry.topology().half_edges(curve.edge)[0];
        c.coordinate = largest_coordinate(view_.scene, h);
        c.spacing = view_.scene.spacing->of(vertex(view_.scene, h, h.first()));
        return c;
    }

    // Starts a sample of `own` at its point t, seen at u in the undistorted image.
    void start(const CoincidentCurve& own, Vec2 u, double t) {
        own_ = {&own, t, (1 - t) * own.curve.a + t * own.curve.b};
        u_ = u;
        for (int k = 0; k < 2; ++k) first_[k] = {}, several_[k] = false, before_[k] = own_.side(k).face >= 0;
    }

    // Adds another curve that passes through u. Returns false once the gradient goes to others, whatever follows.
    bool add(const CoincidentCurve& other, double t) {
        const CurveAtPoint at{&other, t, (1 - t) * other.curve.a + t * other.curve.b};
        for (int k = 0; k < 2; ++k) {
            if (other.side[k].face < 0) continue;
            several_[k] |= first_[k].curve != nullptr;
            if (first_[k].curve && !lies_before(at, first_[k], k)) continue;
            first_[k] = at;
            before_[k] = before_[k] && lies_before(own_, at, k);
        }
        return before_[0] || before_[1];
    }

    // Sets `share`. Returns false where the gradient goes to others.
    bool finish(CoincidentShare& share) const {
        if (!before_[0] && !before_[1]) return false;
        share = {};
        for (int k = 0; k < 2; ++k) {
            const CurveAtPoint& p = before_[k] ? own_ : first_[k];
            share.side[k].face = -1;
            if (p.curve) share.side[k] = p.side(k), share.side_t[k] = p.t;
        }
        if (before_[0] && before_[1]) return true;
        const int near = share.front = before_[0] ? 0 : 1, far = 1 - near;
        const CurveAtPoint& opposite = first_[far];
        if (opposite.curve) {
            share.far_depth = opposite.point.z;
            if (touch(own_, opposite)) share.weight = 0.5;
            else if (opposite.point.z < own_.point.z) return false;
        }
        if (own_.side(far).face >= 0) return true;

        const CurveAtPoint& next = first_[near];
        bool recedes = false;
        for (const HalfEdge& h : own_.curve->edge_on) {
            EdgePoint end;
            int corner[2];
            if (!other_side(h, end, corner) || std::fabs(end.point.z - own_.point.z) <= tolerance(own_, own_)) continue;
            if (end.point.z < own_.point.z) {
                share.second = end, share.halves = true;
                return true;
            }
            if (recedes) continue;
            recedes = true;
            // The uncovered point is the middle of the segment that the ray runs along.
            double b[3] = {0, 0, 0};
            b[h.first()] += (1 - own_.t) / 2, b[h.second()] += own_.t / 2;
            b[corner[0]] += (1 - end.t) / 2, b[corner[1]] += end.t / 2;
            share.second = end, share.uncovered = h.face, share.uncovered_b = {b[1], b[2]};
            share.uncovered_depth = own_.point.z;
        }
        if (next.curve && (!recedes || touch(own_, next))) {
            share.second = point_of(next, near);
            share.uncovered = next.side(near).face, share.uncovered_b = at_edge(next.side(near), next.t);
            share.uncovered_depth = next.point.z;
        }
        if (!opposite.curve) return true;
        const bool alone = share.uncovered < 0 && !several_[far] && opposite.curve->edge_on.empty();
        if (share.weight < 1 || alone) share.second = point_of(opposite, far);
        else if (share.uncovered_depth > opposite.point.z) share.second = {}, share.uncovered = -1;
        return true;
    }

   private:
    // A CurveAtPoint is a curve at the point where it passes through u.
    struct CurveAtPoint {
        const CoincidentCurve* curve = nullptr;
        double t = 0;
        Vec3 point;

        const HalfEdge& side(int k) const { return curve->side[k]; }
    };

    Vec3 opposite_corner(const HalfEdge& h) const {
        return view_.vertices.q[vertex(view_.scene, h, (h.corner + 2) % 3)];
    }

    // Returns the pixel position of q times its weight.
    Vec3 homogeneous(Vec3 q) const {
        const double *k = view_.camera.k, w = view_.camera.depth_weight(q);
        return {k[0] * q.x + k[1] * q.y + k[2] * w, k[3] * q.x + k[4] * q.y + k[5] * w, w};
    }

    // Returns whether a face next to a curve is no wider in the image than the rounding of doubles.
    bool lies_on(const HalfEdge& h, const Curve& c) const {
        const Vec2 along = c.tangent();
        const Vec3 o = homogeneous(opposite_corner(h));
        return std::fabs(wedge(along, {o.x - o.z * c.x0.x, o.y - o.z * c.x0.y})) <= c.rounding * length(along) * o.z;
    }

    double tolerance(const CurveAtPoint& p, const CurveAtPoint& q) const {
        return contact(std::max(p.curve->spacing, q.curve->spacing), std::max(p.curve->coordinate, q.curve->coordinate),
                       std::max(length(p.point), length(q.point)));
    }

    bool touch(const CurveAtPoint& p, const CurveAtPoint& q) const {
        return std::fabs(p.point.z - q.point.z) <= tolerance(p, q);
    }

    // Returns which of two faces that end on the same side lies in front. This is a strict order, the same for all
    // callers. Where they touch, the plane of the one in front separates the other from the viewer.
    bool lies_before(const CurveAtPoint& p, const CurveAtPoint& q, int k) const {
        const double gap = q.point.z - p.point.z;
        if (!touch(p, q)) return gap > 0;
        const Curve& line = (p.curve->curve.edge < q.curve->curve.edge ? p : q).curve->curve;
        const Vec3 along = line.b - line.a, u = opposite_corner(p.side(k)) - p.point,
                   v = opposite_corner(q.side(k)) - q.point, normal = cross(along, u);
        const double viewer = -dot(normal, view_.camera.view_direction(p.point)), other = dot(normal, v);
        if (std::fabs(other) > rounding_of_triple_product(along, u, v)) return (viewer > 0) != (other > 0);
        if (std::fabs(gap) > rounding_of_doubles * std::max(length(p.point), length(q.point))) return gap > 0;
        return p.curve->curve.edge < q.curve->curve.edge;
    }

    EdgePoint point_of(const CurveAtPoint& p, int k) const {
        const HalfEdge& h = p.side(k);
        return {{vertex(view_.scene, h, h.first()), vertex(view_.scene, h, h.second())}, p.t, p.point};
    }

    // Finds where the ray through u leaves a face that it runs along, starting at the curve itself. Sets the point and
    // the corners of the side on which it leaves.
    bool other_side(const HalfEdge& h, EdgePoint& end, int (&corner)[2]) const {
        const Vec2 along = own_.curve->curve.tangent();
        const auto beyond = [&](Vec3 q) {  // position along the line relative to u; affine in q
            const Vec3 o = homogeneous(q);
            return along.x * (o.x - o.z * u_.x) + along.y * (o.y - o.z * u_.y);
        };
        corner[1] = (h.corner + 2) % 3;
        const Vec3 o = opposite_corner(h);
        const double at_o = beyond(o);
        for (const int c : {h.first(), h.second()}) {
            const Vec3 q = view_.vertices.q[vertex(view_.scene, h, c)];
            const double at_q = beyond(q);
            if ((at_q > 0) == (at_o > 0)) continue;
            corner[0] = c;
            end = {{vertex(view_.scene, h, c), vertex(view_.scene, h, corner[1])}, at_q / (at_q - at_o), {}};
            end.point = (1 - end.t) * q + end.t * o;
            return view_.camera.depth_weight(end.point) > 0;
        }
        return false;
    }

    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    CurveAtPoint own_, first_[2];  // front-most of the others, on either side
    bool several_[2] = {};
    bool before_[2] = {};  // whether the curve's own face lies before that one
    Vec2 u_;
};

}  // namespace edgegrad
