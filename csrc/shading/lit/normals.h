// Computes the shading normal of a point, and its _vjp. The normal is that of the face, interpolated between vertex
// normals, or perturbed by a normal map.
#pragma once

#include "shading/lit/source.h"

namespace edgegrad {

struct NormalSource {
    int normals = no_table;
    const int32_t* normal_faces = nullptr;  // (F, 3) rows of normals
    Source map;
    int map_scale = no_table;
    Source tangents;  // Corners have tangents with the handedness (edgegrad/scene/mikktspace.py), else faces.

    bool is_flat() const { return normals == no_table && !map.exists(); }
};

template <class V>
struct FaceFrame {
    V corner[3];
    V g;  // unit normal of the side from which the corners run counter-clockwise
};

// Holds the interpolated normal on the side of g.
template <class S>
struct SmoothNormal {
    Vector<S> sum;  // not normalised
    bool exists = false, turned = false;
    Vector<S> n;
};
template <class S>
SmoothNormal<S> smooth_normal(const std::vector<Table>& tables, const NormalSource& source, const FacePoint<S>& at,
                              Vector<S> g) {
    SmoothNormal<S> o;
    o.n = g;
    if (source.normals == no_table) return o;
    const int32_t* rows = source.normal_faces + 3 * at.face;
    for (int i = 0; i < 3; ++i) o.sum += at.b[i] * tables[source.normals].vector_at<S>(rows[i]);
    o.exists = dot(plain(o.sum), plain(o.sum)) > 0;
    if (!o.exists) return o;
    o.n = unit(o.sum);
    o.turned = dot(plain(o.n), plain(g)) < 0;
    if (o.turned) o.n = -1.0 * o.n;
    return o;
}
inline void smooth_normal_vjp(const std::vector<Table>& tables, const NormalSource& source, const FacePoint<double>& at,
                              const SmoothNormal<double>& o, Vec3 n_bar, Vec3& g_bar, FacePointBar& at_bar,
                              Cotangents& to) {
    if (!o.exists) {
        g_bar += n_bar;
        return;
    }
    const Vec3 sum_bar = unit_vjp(o.sum, o.turned ? -n_bar : n_bar);
    const int32_t* rows = source.normal_faces + 3 * at.face;
    for (int i = 0; i < 3; ++i) {
        at_bar.b[i] += dot(sum_bar, tables[source.normals].vector_at<double>(rows[i]));
        to.add(source.normals, rows[i], at.b[i] * sum_bar);
    }
}

// A perturbed normal that is not longer than this, unnormalised, has no direction. Its derivatives would be as large as
// it is short. An 8-bit map is off by up to 1/255 in each component, √3/255 in length. The map is ignored there.
constexpr double faintest_normal = 1.0 / 128;

// Holds the frame of texture coordinates at the point, and the map's normal in it.
template <class S>
struct MappedNormal {
    S d1 = 0, d2 = 0;                       // change of v along the edges from the first corner
    Vector<S> e1, e2;                       // these edges
    double hand = 1;                        // −1 where the image is mirrored
    Vector<S> along, across, t, bitangent;  // ∂x/∂u of any length, its part normal to n, and unit vectors
    S mapped[3], scale;
    Vector<S> m;
    bool exists = false;
};
template <class S>
MappedNormal<S> mapped_normal(const std::vector<Table>& tables, const NormalSource& source, const FacePoint<S>& at,
                              const FaceFrame<Vector<S>>& frame, Vector<S> n) {
    MappedNormal<S> o;
    if (source.tangents.exists()) {
        S tangent[4];
        value(tables, source.tangents, at, 4, tangent);
        o.along = vector(tangent[0], tangent[1], tangent[2]);
        if (plain(tangent[3]) < 0) o.hand = -1;
    } else {
        Uv<S> uv[3];
        for (int i = 0; i < 3; ++i) uv[i] = corner_uv<S>(tables, source.map, at.face, i);
        o.d1 = uv[1].v - uv[0].v, o.d2 = uv[2].v - uv[0].v;
        o.e1 = frame.corner[1] - frame.corner[0], o.e2 = frame.corner[2] - frame.corner[0];
        if (plain(uv[1].u - uv[0].u) * plain(o.d2) - plain(o.d1) * plain(uv[2].u - uv[0].u) < 0) o.hand = -1;
        o.along = o.hand * (o.d2 * o.e1 - o.d1 * o.e2);
    }
    o.across = o.along - dot(n, o.along) * n;
    value(tables, source.map, at, 3, o.mapped);
    for (S& x : o.mapped) x = S(2) * x - S(1);
    o.scale = tables[source.map_scale].at<S>(0);
    if (!(dot(plain(o.across), plain(o.across)) > 0)) return o;
    o.t = unit(o.across), o.bitangent = o.hand * cross(n, o.t);
    o.m = o.scale * (o.mapped[0] * o.t + o.mapped[1] * o.bitangent) + o.mapped[2] * n;
    o.exists = dot(plain(o.m), plain(o.m)) > faintest_normal * faintest_normal;
    return o;
}

// Adds the cotangents of d2 e1 − d1 e2.
inline void face_tangent_vjp(const Source& map, const FacePoint<double>& at, const MappedNormal<double>& o, Vec3 bar,
                             FaceFrame<Vec3>& frame_bar, Cotangents& to) {
    frame_bar.corner[0] -= (o.d2 - o.d1) * bar;
    frame_bar.corner[1] += o.d2 * bar, frame_bar.corner[2] -= o.d1 * bar;
    const double d1_bar = -dot(o.e2, bar), d2_bar = dot(o.e1, bar);
    const double v_bar[3] = {-d1_bar - d2_bar, d1_bar, d2_bar};
    for (int i = 0; i < 3; ++i) {
        const double uv_bar[2] = {0, v_bar[i]};
        to.add(map.uvs, map.uv_faces[3 * at.face + i], uv_bar);
    }
}

template <class S>
Vector<S> shading_normal(const std::vector<Table>& tables, const NormalSource& source, const FacePoint<S>& at,
                         const FaceFrame<Vector<S>>& frame) {
    const Vector<S> n = smooth_normal(tables, source, at, frame.g).n;
    if (!source.map.exists()) return n;
    const MappedNormal<S> o = mapped_normal(tables, source, at, frame, n);
    return o.exists ? unit(o.m) : n;
}

// Adds to the cotangents of the frame and of the point.
inline void shading_normal_vjp(const std::vector<Table>& tables, const NormalSource& source,
                               const FacePoint<double>& at, const FaceFrame<Vec3>& frame, Vec3 bar,
                               FaceFrame<Vec3>& frame_bar, FacePointBar& at_bar, Cotangents& to) {
    const SmoothNormal<double> smooth = smooth_normal(tables, source, at, frame.g);
    const Vec3 n = smooth.n;
    Vec3 n_bar = bar;
    if (source.map.exists()) {
        const MappedNormal<double> o = mapped_normal(tables, source, at, frame, n);
        if (o.exists) {
            const Vec3 m_bar = unit_vjp(o.m, bar);
            const double scale_bar = dot(m_bar, o.mapped[0] * o.t + o.mapped[1] * o.bitangent);
            to.add(source.map_scale, 0, &scale_bar);
            double map_bar[3] = {2 * o.scale * dot(m_bar, o.t), 2 * o.scale * dot(m_bar, o.bitangent),
                                 2 * dot(m_bar, n)};
            value_vjp(tables, source.map, at, 3, map_bar, at_bar, to);
            n_bar = o.mapped[2] * m_bar;
            Vec3 t_bar = o.scale * o.mapped[0] * m_bar;
            cross_vjp(n, o.t, o.hand * o.scale * o.mapped[1] * m_bar, n_bar, t_bar);
            // This differentiates across = along − n (n · along).
            const Vec3 across_bar = unit_vjp(o.across, t_bar);
            const double kept = dot(n, across_bar);
            const Vec3 along_bar = across_bar - kept * n;
            n_bar -= dot(n, o.along) * across_bar + kept * o.along;
            if (source.tangents.exists()) {
                const double tangent_bar[4] = {along_bar.x, along_bar.y, along_bar.z, 0};
                value_vjp(tables, source.tangents, at, 4, tangent_bar, at_bar, to);
            } else {
                face_tangent_vjp(source.map, at, o, o.hand * along_bar, frame_bar, to);
            }
        }
    }
    smooth_normal_vjp(tables, source, at, smooth, n_bar, frame_bar.g, at_bar, to);
}

}  // namespace edgegrad
