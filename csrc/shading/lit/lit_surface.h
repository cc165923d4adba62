// Describes a surface point that light illuminates: its position, normals and material, each with its _vjp.
#pragma once

#include <algorithm>
#include <vector>

#include "core/dual.h"
#include "shading/lit/bsdf.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

template <class S>
struct Surface {
    const LitMesh* mesh;
    FacePoint<S> at;
    FaceFrame<Vector<S>> frame;
    Vector<S> y, v;  // position, and the unit direction to the viewer
    Vector<S> g, n;  // unit normals of the face and for shading, on the viewer's side
    double side;     // 1 in front of the face, −1 behind it
    Scattering<S> scattering;

    bool is_black() const { return side < 0 && mesh->has_material && !mesh->two_sided; }
};

template <class S>
Vector<S> towards_viewer(const LitScene& lit, Vector<S> y) {
    const Vector<S> eye = lit.tables[lit.eye].vector_at<S>(0);
    return lit.perspective ? unit(eye - y) : eye;
}

// Sets the position. It writes in place, because a surface is large and its material follows later. It keeps a
// reference to `spread` (null: unknown).
template <class S>
void set_place(const LitScene& lit, int64_t face, const S* b, const S* spread, Surface<S>& o) {
    const std::vector<Table>& tables = lit.tables;
    o.mesh = &lit.mesh_of(face);
    o.at = {face - o.mesh->first_face, lit.faces + 3 * face, o.mesh->first_vertex, {b[0], b[1], b[2]}, spread};
    o.y = Vector<S>();
    for (int i = 0; i < 3; ++i) {
        o.frame.corner[i] = tables[lit.verts].vector_at<S>(o.at.vertex[i]);
        o.y += o.at.b[i] * o.frame.corner[i];
    }
    o.frame.g = unit(cross(o.frame.corner[1] - o.frame.corner[0], o.frame.corner[2] - o.frame.corner[0]));
}
// Sets the visible side for the unit direction v to the viewer.
template <class S>
void set_view(const LitScene& lit, Vector<S> v, Surface<S>& o) {
    o.v = v;
    o.side = dot(plain(o.frame.g), plain(o.v)) >= 0 ? 1 : -1;
    o.g = o.side * o.frame.g;
    o.scattering.lambertian = !o.mesh->has_material || o.mesh->lambertian;
    o.n = o.mesh->normal.is_flat() ? o.g : o.side * shading_normal(lit.tables, o.mesh->normal, o.at, o.frame);
}
// Sets a surface as the scene's viewer sees it.
template <class S>
void set_surface(const LitScene& lit, int64_t face, const S* b, const S* spread, Surface<S>& o) {
    set_place(lit, face, b, spread, o);
    set_view<S>(lit, towards_viewer<S>(lit, o.y), o);
}

// Sets the base colour and the other parameters of the BSDF.
constexpr double plain_color = 0.7;  // A mesh without colours has this one (PLAIN in edgegrad/scene/mesh.py).
template <class S>
void look_up_material(const LitScene& lit, Surface<S>& o) {
    const LitMesh& mesh = *o.mesh;
    const int C = lit.channels;
    Scattering<S>& s = o.scattering;
    if (mesh.color.exists()) value(lit.tables, mesh.color, o.at, C, s.base);
    else std::fill(s.base, s.base + C, S(mesh.base.exists() ? 1 : plain_color));
    if (mesh.base.exists()) {
        S factor[most_lit_channels];
        value(lit.tables, mesh.base, o.at, C, factor);
        for (int c = 0; c < C; ++c) s.base[c] *= factor[c];
    }
    s.metallic = 0, s.roughness = 1;
    if (mesh.metallic.exists()) value(lit.tables, mesh.metallic, o.at, 1, &s.metallic);
    if (mesh.roughness.exists()) value(lit.tables, mesh.roughness, o.at, 1, &s.roughness);
}

// Holds the cotangents of a surface point.
struct SurfaceBar {
    Vec3 y, v, g, n;
    Scattering<double> scattering;
    FaceFrame<Vec3> frame;
    FacePointBar at;

    explicit SurfaceBar(int channels) {
        std::fill(scattering.base, scattering.base + channels, 0.0);
        scattering.metallic = scattering.roughness = 0;
    }
};

inline void look_up_material_vjp(const LitScene& lit, const Surface<double>& o, SurfaceBar& bar, Cotangents& to) {
    const LitMesh& mesh = *o.mesh;
    const int C = lit.channels;
    const Scattering<double>& s_bar = bar.scattering;
    const double* color_bar = s_bar.base;
    double of_color[most_lit_channels];
    if (mesh.base.exists()) {
        double own[most_lit_channels], factor[most_lit_channels], factor_bar[most_lit_channels];
        if (mesh.color.exists()) value(lit.tables, mesh.color, o.at, C, own);
        else std::fill(own, own + C, 1.0);
        value(lit.tables, mesh.base, o.at, C, factor);
        for (int c = 0; c < C; ++c) factor_bar[c] = s_bar.base[c] * own[c], of_color[c] = s_bar.base[c] * factor[c];
        value_vjp(lit.tables, mesh.base, o.at, C, factor_bar, bar.at, to);
        color_bar = of_color;
    }
    if (mesh.color.exists()) value_vjp(lit.tables, mesh.color, o.at, C, color_bar, bar.at, to);
    if (mesh.metallic.exists()) value_vjp(lit.tables, mesh.metallic, o.at, 1, &s_bar.metallic, bar.at, to);
    if (mesh.roughness.exists()) value_vjp(lit.tables, mesh.roughness, o.at, 1, &s_bar.roughness, bar.at, to);
}

// Adds the cotangents of position and eye, from the cotangent of the direction to the viewer.
inline void view_vjp(const LitScene& lit, const Surface<double>& o, SurfaceBar& bar, Cotangents& to) {
    if (o.scattering.lambertian) return;  // A Lambertian surface has one radiance in all directions.
    if (!lit.perspective) return to.add(lit.eye, 0, bar.v);
    const Vec3 towards_bar = unit_vjp(lit.tables[lit.eye].vector_at<double>(0) - o.y, bar.v);
    to.add(lit.eye, 0, towards_bar), bar.y -= towards_bar;
}
// Adds the cotangents of barycentrics, vertices and normals, from the cotangents of position and normals.
inline void place_vjp(const LitScene& lit, const Surface<double>& o, SurfaceBar& bar, Cotangents& to) {
    if (o.mesh->normal.is_flat()) bar.g += bar.n;
    else shading_normal_vjp(lit.tables, o.mesh->normal, o.at, o.frame, o.side * bar.n, bar.frame, bar.at, to);
    bar.frame.g += o.side * bar.g;
    const Vec3* p = o.frame.corner;
    const Vec3 e1 = p[1] - p[0], e2 = p[2] - p[0];
    Vec3 e1_bar, e2_bar;
    cross_vjp(e1, e2, unit_vjp(cross(e1, e2), bar.frame.g), e1_bar, e2_bar);
    bar.frame.corner[0] -= e1_bar + e2_bar, bar.frame.corner[1] += e1_bar, bar.frame.corner[2] += e2_bar;
    for (int i = 0; i < 3; ++i) {
        bar.at.b[i] += dot(bar.y, p[i]);
        to.add(lit.verts, o.at.vertex[i], bar.frame.corner[i] + o.at.b[i] * bar.y);
    }
}
inline void surface_vjp(const LitScene& lit, const Surface<double>& o, SurfaceBar& bar, Cotangents& to) {
    view_vjp(lit, o, bar, to);
    place_vjp(lit, o, bar, to);
}

}  // namespace edgegrad
