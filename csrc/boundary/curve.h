// This file finds the curves along edges at which the image jumps: silhouettes, open borders and creases. An edge may
// have any number of faces.
//
// On each side of the edge in the image one surface is visible next to it. It is the front-most incident face on that
// side, or, if there is none, what lies behind. If both have the same radiance by construction, there is no curve.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "estimator/view.h"
#include "scene/topology.h"
#include "shading/shade.h"

namespace edgegrad {

struct Curve {
    int64_t edge = -1;
    HalfEdge minus, plus;   // faces next to the curve; face −1: none, what lies behind is visible
    Vec3 a, b;              // ends of the edge, camera coordinates
    double t0 = 0, t1 = 0;  // interval of the edge within the view
    double w0 = 1, w1 = 1;  // depth weights at t0 and t1
    Vec2 x0, x1;            // pixel positions at t0 and t1
    double length = 0;      // px
    double rounding = 0;    // px, rounding of the positions

    bool is_crease() const { return minus.face >= 0 && plus.face >= 0; }

    // low() and high() return corners of its box.
    Vec2 low() const { return {std::min(x0.x, x1.x), std::min(x0.y, x1.y)}; }
    Vec2 high() const { return {std::max(x0.x, x1.x), std::max(x0.y, x1.y)}; }
    double nearest_depth() const { return std::min((1 - t0) * a.z + t0 * b.z, (1 - t1) * a.z + t1 * b.z); }

    Vec2 tangent() const { return x1 - x0; }  // dx/ds, a constant: a pinhole sees a straight line

    // At the fraction s in the image, position() returns px and parameter() returns t on the edge (1 − t) a + t b.
    Vec2 position(double s) const { return x0 + s * (x1 - x0); }
    double parameter(double s) const { return t0 + (t1 - t0) * (s * w0 / ((1 - s) * w1 + s * w0)); }
};

// Returns the barycentrics, in a face, of the point t of its edge. They are exact, since nothing is intersected.
inline Barycentrics at_edge(const HalfEdge& h, double t) {
    double b[3] = {0, 0, 0};
    b[h.first()] = 1 - t, b[h.second()] = t;
    return {b[1], b[2]};
}

// Returns at_edge(), moved slightly inwards if the nearest texel counts: on the border it may be a neighbour's.
template <class T>
Barycentrics next_to_edge(const SceneView<T>& scene, const HalfEdge& h, double t) {
    const Barycentrics b = at_edge(h, t);
    constexpr double inward = 0x1p-24;
    if (!takes_nearest(scene, h.face)) return b;
    return {(1 - inward) * b.u + inward / 3, (1 - inward) * b.v + inward / 3};
}

template <class T>
int32_t vertex(const SceneView<T>& scene, const HalfEdge& h, int corner) {
    return scene.faces[3 * int64_t(h.face) + corner];
}

// Returns whether the first of two faces on the same side of the edge (a, b) in the image lies in front. Then its plane
// separates the other one from the viewer.
template <class T>
bool in_front(const BackwardView<T>& view, const HalfEdge& first, const HalfEdge& second, Vec3 a, Vec3 b) {
    const auto opposite = [&](const HalfEdge& h) { return view.vertices.q[vertex(view.scene, h, (h.corner + 2) % 3)]; };
    const Vec3 normal = cross(b - a, opposite(first) - a);
    const double viewer = -dot(normal, view.camera.view_direction(a)), other = dot(normal, opposite(second) - a);
    return other == 0 || (viewer > 0) != (other > 0);
}

// Returns whether two rows of an array differ.
template <class Number>
bool rows_differ(const Number* values, int width, int64_t i, int64_t j) {
    if (i == j) return false;
    for (int c = 0; c < width; ++c)
        if (values[width * i + c] != values[width * j + c]) return true;
    return false;
}

// Returns whether two faces differ in texture coordinates along the edge they share.
template <class T>
bool uvs_jump(const SceneView<T>& scene, const HalfEdge& m, const HalfEdge& p) {
    const auto row = [&](const HalfEdge& h, int corner) { return scene.uv_corners[3 * int64_t(h.face) + corner]; };
    return rows_differ(scene.uvs, 2, row(m, m.first()), row(p, p.first())) ||
           rows_differ(scene.uvs, 2, row(m, m.second()), row(p, p.second()));
}

// Returns whether two faces may differ in attributes along the edge they share. Barycentrics belong to one face alone.
template <class T>
bool attributes_jump(const SceneView<T>& scene, const HalfEdge& m, const HalfEdge& p) {
    const Attributes& a = scene.attributes;
    return a.barycentrics || (a.uv && uvs_jump(scene, m, p)) || rows_differ(a.face, a.face_width, m.face, p.face) ||
           rows_differ(a.vertex, a.vertex_width, vertex(scene, m, m.first()), vertex(scene, p, p.first())) ||
           rows_differ(a.vertex, a.vertex_width, vertex(scene, m, m.second()), vertex(scene, p, p.second()));
}

// Returns whether an edge runs exactly along a texel edge. Other texel edges are discontinuities.
template <class T>
bool lies_between_texels(const SceneView<T>& scene, const HalfEdge& h) {
    if (!takes_nearest(scene, h.face)) return false;
    const auto along = [&](const auto& texture) {
        const auto place = [&](int corner) {
            const double* uv = scene.uvs + 2 * int64_t(scene.uv_corners[3 * int64_t(h.face) + corner]);
            return texture.place({uv[0], uv[1]});
        };
        const Vec2 a = place(h.first()), b = place(h.second());
        return (a.x == b.x && a.x == std::floor(a.x)) || (a.y == b.y && a.y == std::floor(a.y));
    };
    return (is_textured(scene, h.face) && along(texture_of(scene, h.face))) ||
           (scene.alpha_masks.on(h.face) && along(alpha_of(scene, h.face)));
}

// Returns whether alpha masks may differ between two faces along the edge they share.
template <class T>
bool alpha_masks_jump(const SceneView<T>& scene, const HalfEdge& m, const HalfEdge& p) {
    const AlphaMaskArrays<T>& c = scene.alpha_masks;
    if (!c.on(m.face) && !c.on(p.face)) return false;
    return c.face[m.face] != c.face[p.face] || lies_between_texels(scene, m) || uvs_jump(scene, m, p);
}

// Returns whether two faces may differ along the edge they share, by their values at its ends.
template <class T>
bool carries_jump(const SceneView<T>& scene, const HalfEdge& m, const HalfEdge& p) {
    const bool textured = is_textured(scene, m.face);
    if (textured != is_textured(scene, p.face)) return true;
    if (textured && scene.face_texture[m.face] != scene.face_texture[p.face]) return true;
    if (textured && lies_between_texels(scene, m)) return true;
    const auto differ = [&](int of_m, int of_p) {
        const int64_t i = scene.corners[3 * int64_t(m.face) + of_m], j = scene.corners[3 * int64_t(p.face) + of_p];
        return textured ? rows_differ(scene.uvs, 2, i, j) : rows_differ(scene.colors, scene.radiance, i, j);
    };
    return differ(m.first(), p.first()) || differ(m.second(), p.second()) ||
           (scene.channels > scene.radiance && attributes_jump(scene, m, p)) || alpha_masks_jump(scene, m, p);
}

// Returns whether neighbouring faces may differ at their common edge. Attributes indexed like the vertices agree on
// both sides of an edge, unless it joins copies.
template <class T>
bool may_jump(const SceneView<T>& scene, const Topology& topology) {
    const Attributes& a = scene.attributes;
    return scene.corners != scene.faces || topology.welds() || a.face_width > 0 || a.barycentrics || a.uv ||
           scene.alpha_masks.face;
}

// Returns the scene without its first channels if these are the same on both sides of any edge. They are what is
// interpolated from vertices, unless copies are joined, and alpha where nothing is alpha-tested.
template <class T>
SceneView<T> without_continuous(SceneView<T> scene, const Topology& topology) {
    if (scene.corners != scene.faces || topology.welds() || scene.face_texture || scene.alpha_masks.face) return scene;
    Attributes& a = scene.attributes;
    a.alpha = false, a.vertex_width = 0, a.unit = -1;
    scene.radiance = 0, scene.channels = a.channels();
    return scene;
}

// Returns the side of an edge on which a face lies: > 0: minus, < 0: plus, 0: it is seen edge-on and covers nothing. A
// face that turns clockwise in the image (x right, y down) lies to the right of its sides. The normal (τ_y, −τ_x)
// points to the left.
inline int side_of(const HalfEdge& h, const Array<int8_t>& facing) {
    return h.backwards ? -facing[h.face] : facing[h.face];
}

// Returns the orientation of each face in the image, Camera::facing (F,). It is that of the corners in the image, if
// these lie inside the view and rounding does not decide.
template <class T>
Array<int8_t> facing_of_faces(const BackwardView<T>& view) {
    Array<int8_t> facing(view.scene.n_faces);
    const double rounding = 16 * view.camera.rounding_of_positions();
    view.team.parallel_for_blocks(view.scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
        constexpr int64_t ahead = 16;
        for (int64_t f = first; f < last; ++f) {
            const int32_t* v = view.scene.faces + 3 * f;
            if (f + ahead < last)
                for (int i = 0; i < 3; ++i) prefetch(&view.vertices.x[v[3 * ahead + i]]);
            const Array<uint8_t>& outcode = view.vertices.outcode;
            if (!(outcode[v[0]] | outcode[v[1]] | outcode[v[2]])) [[likely]] {
                const Vec2 x0 = view.vertices.x[v[0]], e1 = view.vertices.x[v[1]] - x0, e2 = view.vertices.x[v[2]] - x0;
                const double twice = wedge(e1, e2);
                const double side = std::fabs(e1.x) + std::fabs(e1.y) + std::fabs(e2.x) + std::fabs(e2.y);
                if (std::fabs(twice) > rounding * side) [[likely]] {
                    facing[f] = twice > 0 ? 1 : -1;
                    continue;
                }
            }
            const auto q = corners_of(view, f);
            facing[f] = int8_t(view.camera.facing(q[0], q[1], q[2]));
        }
    });
    return facing;
}

// CurveFinder finds the curves of one view.
template <class T>
class CurveFinder {
   public:
    // `facing` (F,): see facing_of_faces.
    CurveFinder(const BackwardView<T>& view, Array<int8_t> facing)
        : view_(view), facing_(std::move(facing)), jumps_(may_jump(view.scene, view.geometry.topology())) {}

    bool finds_creases() const { return jumps_; }
    const Array<int8_t>& facing() const { return facing_; }

    // Returns the side of its edge on which a face lies in the image; see side_of.
    int facing_of(const HalfEdge& h) const { return side_of(h, facing_); }

    // EarlyOut tells what is known of an edge between two faces. `done`: there is no curve, or nothing more to do.
    // `differs`: the faces differ along it. `unknown`: nothing.
    enum class EarlyOut { done, differs, unknown };

    // Calls body(edge) for those of the edges first … last − 1 that may have a curve. Most have one face on each side.
    // There early_out(edge, face, face) tells whether to look further, so little memory is read for them.
    template <class See, class Body>
    void each(int64_t first, int64_t last, See early_out, Body body) const {
        const Topology& topology = view_.geometry.topology();
        const int8_t* const facing = facing_.data();
        const int32_t* face = topology.faces(first).data();
        std::vector<int64_t> edges, joins;  // edges that may have a curve; those that need a jump
        const int32_t* const end =
            last < topology.n_edges() ? topology.faces(last).data() : topology.faces(last - 1).data();
        for (int64_t e = first; e < last; ++e) {
            if (face + 2 * ahead_far < end)
                early_out.prefetch(face[2 * ahead_far]), early_out.prefetch(face[2 * ahead_far + 1]);
            if (topology.joins_two(e)) [[likely]] {
                const int32_t one = face[0], other = face[1];
                face += 2;
                if (facing[one] * facing[other] > 0) {
                    const EarlyOut seen = jumps_ ? early_out(e, one, other) : EarlyOut::done;
                    if (seen == EarlyOut::unknown) joins.push_back(e);
                    if (seen != EarlyOut::differs) continue;
                }
            } else {
                face += topology.faces(e).size();
            }
            edges.push_back(e);
            topology.prefetch(e);
        }
        if (!joins.empty()) {
            const size_t others = edges.size();
            for (size_t i = 0; i < joins.size(); ++i) {
                if (i + 2 * ahead_far < joins.size()) prefetch_corners(joins[i + 2 * ahead_far]);
                if (i + ahead_far < joins.size()) prefetch_values(joins[i + ahead_far]);
                if (carries_jump(joins[i])) edges.push_back(joins[i]);
            }
            std::inplace_merge(edges.begin(), edges.begin() + others, edges.end());
        }
        for (size_t i = 0; i < edges.size(); ++i) {
            if (i + 2 * ahead_near < edges.size()) {
                prefetch_faces(edges[i + 2 * ahead_near]);
                if (jumps_) prefetch_corners(edges[i + 2 * ahead_near]);
            }
            if (i + ahead_near < edges.size()) {
                prefetch_vertices(edges[i + ahead_near]);
                if (jumps_) prefetch_values(edges[i + ahead_near]);
            }
            if (i + ahead_near / 2 < edges.size()) prefetch_place(edges[i + ahead_near / 2]);
            body(edges[i]);
        }
    }

    // NoCreases makes edges between two faces count only if they are silhouettes.
    struct NoCreases {
        EarlyOut operator()(int64_t, int32_t, int32_t) const { return EarlyOut::done; }
        void prefetch(int32_t) const {}
    };

    // Sets the curve of an edge. Returns false if there is none.
    bool find(int64_t edge, Curve& c) const {
        const auto halves = view_.geometry.topology().half_edges(edge);
        // This repeats the test of each().
        if (!jumps_ && halves.size() == 2 && side_of(halves[0], facing_) * side_of(halves[1], facing_) < 0)
            return false;
        const int32_t va = vertex(view_.scene, halves[0], halves[0].first()),
                      vb = vertex(view_.scene, halves[0], halves[0].second());
        const VertexView& p = view_.vertices;
        if (p.outcode[va] & p.outcode[vb]) return false;
        c.a = p.q[va], c.b = p.q[vb];

        HalfEdge side[2];  // minus, plus
        side[0].face = side[1].face = -1;
        for (const HalfEdge& h : halves) {
            const int facing = side_of(h, facing_);
            if (facing == 0) continue;
            HalfEdge& seen = side[facing > 0 ? 0 : 1];
            if (seen.face < 0 || !in_front(view_, seen, h, c.a, c.b)) seen = h;
        }
        if (side[0].face < 0 && side[1].face < 0) return false;
        if (side[0].face >= 0 && side[1].face >= 0 &&
            !(jumps_ && edgegrad::carries_jump(view_.scene, side[0], side[1])))
            return false;

        const Camera& camera = view_.camera;
        if (!(p.outcode[va] | p.outcode[vb])) {
            c.t0 = 0, c.t1 = 1;
            c.x0 = p.x[va], c.x1 = p.x[vb];
            c.w0 = camera.depth_weight(c.a), c.w1 = camera.depth_weight(c.b);
        } else {
            if (!view_.volume.clip_segment(c.a, c.b, c.t0, c.t1)) return false;
            const Vec3 q0 = (1 - c.t0) * c.a + c.t0 * c.b, q1 = (1 - c.t1) * c.a + c.t1 * c.b;
            c.w0 = camera.depth_weight(q0), c.w1 = camera.depth_weight(q1);
            if (!(c.w0 > 0 && c.w1 > 0)) return false;  // The edge ends in the eye itself.
            c.x0 = view_.volume.inside(project(camera, q0)), c.x1 = view_.volume.inside(project(camera, q1));
        }
        c.edge = edge, c.minus = side[0], c.plus = side[1];
        c.length = length(c.tangent());
        c.rounding = rounding(c, va, vb);
        return c.length > 0 && c.rounding < most_rounding;
    }

    // Sets the crease of an edge between two faces, one on either side of it in the image. Both must lie in the view,
    // and the edge's rounding must not matter.
    bool find_between(int64_t edge, Curve& c) const {
        const auto halves = view_.geometry.topology().half_edges(edge);
        const int minus = side_of(halves[0], facing_) > 0 ? 0 : 1;
        const int32_t va = vertex(view_.scene, halves[0], halves[0].first()),
                      vb = vertex(view_.scene, halves[0], halves[0].second());
        const VertexView& p = view_.vertices;
        c.edge = edge, c.minus = halves[minus], c.plus = halves[1 - minus];
        c.a = p.q[va], c.b = p.q[vb], c.x0 = p.x[va], c.x1 = p.x[vb];
        c.t0 = 0, c.t1 = 1, c.rounding = 0;
        c.w0 = view_.camera.depth_weight(c.a), c.w1 = view_.camera.depth_weight(c.b);
        c.length = length(c.tangent());
        return c.length > 0;
    }

    // Returns the rounding of the curve of an edge inside the view.
    double rounding(const Curve& c) const {
        const HalfEdge& h = c.minus.face >= 0 ? c.minus : c.plus;
        return rounding(c, vertex(view_.scene, h, h.first()), vertex(view_.scene, h, h.second()));
    }

    // Returns the rounding of pixel positions, px. Coordinates are at most p in size, axis by axis; depth weights are
    // at least w; the positions add up to `pixels`. A sum q = R p + t is rounded by its largest terms, so a distant
    // orthographic camera loses depth, not position. In perspective, X / Z is rounded with X, and with Z by its terms.
    double rounding(const double (&p)[3], double w, double pixels) const {
        const Camera& camera = view_.camera;
        const auto terms = [&](int row, double t) {
            const Vec3 r = camera.R.row[row];
            return std::fabs(r.x) * p[0] + std::fabs(r.y) * p[1] + std::fabs(r.z) * p[2] + std::fabs(t);
        };
        const double across = std::max(terms(0, camera.t.x), terms(1, camera.t.y)),
                     depth = camera.roundings_of_weight(terms(2, camera.t.z), w);
        return 32 * std::numeric_limits<double>::epsilon() *
               (camera.pixels_per_unit / w * across +
                std::max(1.0, depth) * (std::fabs(camera.k[2]) + std::fabs(camera.k[5]) + pixels));
    }

   private:
    // Memory is prefetched this many edges ahead: `ahead_far` where little is done for each edge, `ahead_near` where
    // more is.
    static constexpr size_t ahead_far = 24, ahead_near = 4;

    void prefetch_corners(int64_t edge) const {
        for (const int32_t f : view_.geometry.topology().faces(edge)) {
            prefetch_all(view_.scene.corners + 3 * int64_t(f), 3);
            if (view_.scene.face_texture) prefetch(view_.scene.face_texture + f);
        }
    }
    void prefetch_values(int64_t edge) const {
        for (const int32_t f : view_.geometry.topology().faces(edge)) {
            const int64_t row = view_.scene.corners[3 * int64_t(f)];
            if (is_textured(view_.scene, f)) prefetch(view_.scene.uvs + 2 * row);
            else prefetch_all(view_.scene.colors + view_.scene.radiance * row, view_.scene.radiance);
            if (const int width = view_.scene.attributes.face_width)
                prefetch_all(view_.scene.attributes.face + width * int64_t(f), width);
        }
    }
    void prefetch_faces(int64_t edge) const {
        for (const int32_t f : view_.geometry.topology().faces(edge))
            prefetch_all(view_.scene.faces + 3 * int64_t(f), 3);
    }
    void prefetch_vertices(int64_t edge) const {
        const HalfEdge& h = view_.geometry.topology().half_edges(edge)[0];
        const VertexView& p = view_.vertices;
        for (const int corner : {h.first(), h.second()}) {
            const int32_t v = vertex(view_.scene, h, corner);
            prefetch_all(&p.q[v], 1), prefetch(&p.x[v]), prefetch(&p.outcode[v]);
            prefetch_all(view_.scene.verts + 3 * int64_t(v), 3);
        }
    }

    void prefetch_place(int64_t edge) const {
        const HalfEdge& h = view_.geometry.topology().half_edges(edge)[0];
        for (const int corner : {h.first(), h.second()}) {
            const int32_t v = vertex(view_.scene, h, corner);
            if (view_.vertices.outcode[v]) return;
            const Vec2 x = view_.vertices.x[v];
            if (corner == h.first()) view_.importance.prefetch(x);
            if (jumps_) prefetch(view_.adjoint.of(view_.pixel(x)));
        }
    }

    bool carries_jump(int64_t edge) const {
        const auto halves = view_.geometry.topology().half_edges(edge);
        return edgegrad::carries_jump(view_.scene, halves[0], halves[1]);
    }

    // px. An edge so long or so far away that doubles do not determine its image has no curve. The bound is generous.
    static constexpr double most_rounding = 16;

    // Returns the rounding of a curve that ends at these vertices.
    double rounding(const Curve& c, int32_t va, int32_t vb) const {
        double p[3] = {};
        for (const int32_t v : {va, vb})
            for (int i = 0; i < 3; ++i) p[i] = std::max(p[i], std::fabs(view_.scene.verts[3 * int64_t(v) + i]));
        const double pixels = std::fabs(c.x0.x) + std::fabs(c.x0.y) + std::fabs(c.x1.x) + std::fabs(c.x1.y);
        return rounding(p, std::min(c.w0, c.w1), pixels);
    }

    const BackwardView<T>& view_;
    Array<int8_t> facing_;  // orientation of each face in the image
    const bool jumps_;      // false: neighbouring faces carry the same radiance at their edge
};

}  // namespace edgegrad
