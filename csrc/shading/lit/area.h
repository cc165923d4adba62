// Evaluates emissive faces: E = L cos θ / r² over the pdf. The pdf is with respect to area, of a point that keeps its
// barycentrics while faces move.
#pragma once

#include "shading/lit/light.h"

namespace edgegrad {

// Refers to the faces of a mesh that emits.
struct EmissiveFaces {
    const int32_t* faces;  // (F, 3) of the scene
    int64_t first;         // first face of the mesh
    int32_t first_vertex;
    int verts;  // table of vertices
    const Source& emission;
    bool two_sided;

    const int32_t* vertex(int64_t face) const { return faces + 3 * (first + face); }
};

template <class S>
struct Emitter {
    Vector<S> corner[3], away;  // `away` points from the emitter's point to the surface.
    Vector<S> normal, along;    // |normal| is the area; `along` is the unit vector of `away`.
    S squared, facing;
    double sign = 1, per_pdf = 0;
    S radiance[most_lit_channels];

    bool gives() const { return plain(squared) > 0 && per_pdf > 0; }
    S scale() const { return facing / (squared * S(per_pdf)); }
};
template <class S>
FacePoint<S> on_emitter(const EmissiveFaces& from, const LightPoint& p) {
    return {p.index, from.vertex(p.index), from.first_vertex, {S(1 - p.u - p.v), S(p.u), S(p.v)}};
}
template <class S>
Emitter<S> emitter(const std::vector<Table>& tables, const EmissiveFaces& from, const LightPoint& p, int channels,
                   Vector<S> y) {
    Emitter<S> o;
    const FacePoint<S> at = on_emitter<S>(from, p);
    Vector<S> place;
    for (int i = 0; i < 3; ++i) {
        o.corner[i] = tables[from.verts].vector_at<S>(at.vertex[i]);
        place += at.b[i] * o.corner[i];
    }
    o.away = y - place, o.squared = dot(o.away, o.away), o.along = unit(o.away);
    o.normal = 0.5 * cross(o.corner[1] - o.corner[0], o.corner[2] - o.corner[0]);
    o.facing = dot(o.normal, o.along);
    if (plain(o.facing) < 0) o.sign = from.two_sided ? -1 : 0;
    o.facing = S(o.sign) * o.facing;
    // |normal| over its constant value is the Jacobian of the barycentrics, and `facing` brings the cosine.
    o.per_pdf = p.pdf * length(plain(o.normal));
    value(tables, from.emission, at, channels, o.radiance);
    return o;
}

template <class S>
Arriving<S> from_faces(const std::vector<Table>& tables, const EmissiveFaces& from, const LightPoint& p, int channels,
                       Vector<S> y) {
    const Emitter<S> e = emitter<S>(tables, from, p, channels, y);
    Arriving<S> o;
    o.l = -1.0 * e.along;
    for (int c = 0; c < channels; ++c) o.E[c] = e.gives() ? e.radiance[c] * e.scale() : S(0);
    return o;
}
inline void from_faces_vjp(const std::vector<Table>& tables, const EmissiveFaces& from, const LightPoint& p,
                           int channels, Vec3 y, const Arriving<double>& bar, Vec3& y_bar, Cotangents& to) {
    const Emitter<double> e = emitter<double>(tables, from, p, channels, y);
    if (!e.gives()) return;
    const double scale = e.scale();
    double radiance_bar[most_lit_channels], scale_bar = 0;
    for (int c = 0; c < channels; ++c) radiance_bar[c] = bar.E[c] * scale, scale_bar += bar.E[c] * e.radiance[c];
    FacePointBar unused;
    const FacePoint<double> at = on_emitter<double>(from, p);
    value_vjp(tables, from.emission, at, channels, radiance_bar, unused, to);
    const double facing_bar = e.sign * scale_bar / (e.squared * e.per_pdf);
    const Vec3 along_bar = facing_bar * e.normal - bar.l;
    const Vec3 away_bar = unit_vjp(e.away, along_bar) - 2 * scale_bar * scale / e.squared * e.away;
    y_bar += away_bar;
    if (!to.wants(from.verts)) return;
    Vec3 corner_bar[3], e1_bar, e2_bar;
    cross_vjp(e.corner[1] - e.corner[0], e.corner[2] - e.corner[0], 0.5 * facing_bar * e.along, e1_bar, e2_bar);
    corner_bar[0] = -(e1_bar + e2_bar), corner_bar[1] = e1_bar, corner_bar[2] = e2_bar;
    for (int i = 0; i < 3; ++i) to.add(from.verts, at.vertex[i], corner_bar[i] - at.b[i] * away_bar);
}

}  // namespace edgegrad
