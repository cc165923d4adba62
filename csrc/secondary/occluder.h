// This file holds points of the curves that occlude what lies behind them: edges and alpha edges.
//
// Seen along d, a curve p(t) occludes one side of the plane through p spanned by d and dp/dt: F = N · (y − p) with
// N = dp/dt × d. An alpha edge f(b; uv, α) = 0 on a face with the sides e₁, e₂ has ∂p/∂t = κ (−f_v e₁ + f_u e₂). Then
// N·e₁ = κ D f_u and N·e₂ = κ D f_v with D = d · (e₁ × e₂). As f grows by δf, the alpha edge recedes by N·δp = −κ D δf,
// in addition to the motion N · Σ b_i δv_i of the face. The face is opaque where F has the sign of κ D.
#pragma once

#include <algorithm>
#include <cstdint>

#include "accumulate/records.h"
#include "accumulate/scatter.h"
#include "accumulate/tangent.h"
#include "boundary/curve.h"
#include "rays/alpha_mask.h"
#include "scene/topology.h"
#include "secondary/alpha_edges.h"

namespace edgegrad {

// An Occluder is a point p of such a curve, with dp/dt, as weighted sums of vertices. An edge has the two vertices of
// (1 − t) a + t b and b − a; an alpha edge has the three of its face.
struct Occluder {
    int count = 2;
    int32_t vertex[3];
    double weight[3], tangent[3];
    // The members below are set on alpha edges only.
    int32_t uv_row[3];
    double kappa = 0;
    Vec2 by_uv;       // ∂f/∂uv
    Footprint alpha;  // texels and weights of f, if `of_alpha`
    bool of_alpha = false;

    bool is_alpha_edge() const { return count == 3; }
    // Returns the weighted sum of one vector per vertex.
    template <class Values>
    Vec3 sum(const double (&by)[3], Values values) const {
        Vec3 out = by[0] * values(vertex[0]) + by[1] * values(vertex[1]);
        if (count == 3) out += by[2] * values(vertex[2]);
        return out;
    }
    // Returns κ D for the direction d; at(i) returns a vertex.
    template <class At>
    double turned(Vec3 d, At at) const {
        const Vec3 a = at(vertex[0]);
        return kappa * dot(d, cross(at(vertex[1]) - a, at(vertex[2]) - a));
    }

    // -- dependence of f on texture coordinates and alpha texels -----------------------------------------------------

    double alpha_edge_jvp(const Tangents& tangents) const {
        double f_dot = 0;
        if (const double* uvs = tangents.uvs; uvs && is_alpha_edge())
            for (int i = 0; i < 3; ++i) {
                const double* uv_dot = uvs + 2 * int64_t(uv_row[i]);
                f_dot += weight[i] * (by_uv.x * uv_dot[0] + by_uv.y * uv_dot[1]);
            }
        if (const double* alphas = tangents.alphas; alphas && of_alpha)
            for (int k = 0; k < 4; ++k) f_dot += alpha.weight(k) * alphas[alpha.texel[k]];
        return f_dot;
    }
    void alpha_edge_vjp(double f_bar, LocalGradients& grad) const {
        if (is_alpha_edge() && grad.uvs.is_wanted())
            for (int i = 0; i < 3; ++i) {
                const Vec2 uv_bar = (f_bar * weight[i]) * by_uv;
                grad.uvs.add<2>(uv_row[i], &uv_bar.x);
            }
        if (of_alpha && grad.alphas.is_wanted())
            for (int k = 0; k < 4; ++k) {
                const double alpha_bar = f_bar * alpha.weight(k);
                grad.alphas.add<1>(alpha.texel[k], &alpha_bar);
            }
    }
    // Appends the rows of a sample whose curve moves by `by_alpha_edge` times f.
    void append_alpha_edge(double by_alpha_edge, int64_t sample, CurveRecords& records) const {
        if (is_alpha_edge())
            for (int i = 0; i < 3; ++i) {
                const Vec2 by = (by_alpha_edge * weight[i]) * by_uv;
                records.uv_row_of.push_back(sample), records.uv.push_back(uv_row[i]);
                append(records.by_uv, {by.x, by.y});
            }
        if (of_alpha)
            for (int k = 0; k < 4; ++k) {
                records.alpha_row_of.push_back(sample), records.alpha.push_back(alpha.texel[k]);
                records.by_alpha.push_back(by_alpha_edge * alpha.weight(k));
            }
    }
};

// Returns the occluder at the place t of an edge.
template <class T>
Occluder occluder_of(const SceneView<T>& scene, const HalfEdge& h, double t) {
    const int32_t* v = scene.faces + 3 * int64_t(h.face);
    Occluder o;
    o.vertex[0] = v[h.first()], o.vertex[1] = v[h.second()];
    o.weight[0] = 1 - t, o.weight[1] = t, o.weight[2] = 0;
    o.tangent[0] = -1, o.tangent[1] = 1, o.tangent[2] = 0;
    return o;
}
// Returns the occluder at a point of an alpha edge.
template <class T>
Occluder occluder_of(const SceneView<T>& scene, const AlphaEdge& alpha_edge, const AlphaEdgePoint& place) {
    Occluder o;
    o.count = 3;
    for (int i = 0; i < 3; ++i) {
        o.vertex[i] = scene.faces[3 * int64_t(alpha_edge.face) + i];
        o.uv_row[i] = scene.uv_corners[3 * int64_t(alpha_edge.face) + i];
        o.weight[i] = place.b[i];
    }
    const Barycentrics tangent{-place.kappa * place.slope.v, place.kappa * place.slope.u};
    o.tangent[0] = -tangent.u - tangent.v, o.tangent[1] = tangent.u, o.tangent[2] = tangent.v;
    o.kappa = place.kappa, o.by_uv = place.by_uv, o.alpha = place.alpha, o.of_alpha = alpha_edge.border == 0;
    return o;
}
// Returns the point, in world coordinates, at which rays pass an alpha edge. It is moved slightly to the masked side. A
// neighbour that shares the alpha edge along a common edge is then masked there too, or not met.
template <class T>
Vec3 next_to_alpha_edge(const SceneView<T>& scene, const AlphaEdge& alpha_edge, const AlphaEdgePoint& place) {
    constexpr double aside = 1e-7;
    const Vec3 v = corner(scene, alpha_edge.face, 0), e1 = corner(scene, alpha_edge.face, 1) - v,
               e2 = corner(scene, alpha_edge.face, 2) - v;
    const double step = aside / length(Vec2{place.slope.u, place.slope.v});
    return v + (place.b.u - step * place.slope.u) * e1 + (place.b.v - step * place.slope.v) * e2;
}

// Returns whether alpha masks may differ between the faces of an edge.
template <class T>
bool alpha_masks_jump(const SceneView<T>& casters, const Topology& topology, int64_t edge) {
    if (!casters.alpha_masks.face) return false;
    const auto halves = topology.half_edges(edge);
    return std::any_of(halves.begin() + 1, halves.end(),
                       [&](const HalfEdge& h) { return alpha_masks_jump(casters, halves[0], h); });
}
// Returns whether a face is opaque next to a place of its edge.
template <class T>
bool is_there(const SceneView<T>& casters, const HalfEdge& h, double t) {
    return shows(casters, h.face, next_to_edge(casters, h, t));
}

}  // namespace edgegrad
