// Computes what a face shows besides its radiance: alpha, attributes of vertices or faces, barycentrics and texture
// coordinates. All are affine in the barycentrics b, except a direction m, which is normalised after interpolation: n =
// m / |m|, δn = (δm − n (n · δm)) / |m|.
#pragma once

#include "accumulate/gradients.h"
#include "accumulate/scatter.h"
#include "camera/face_map.h"
#include "scene/scene.h"

namespace edgegrad {

// Holds the arrays that attributes are read from, or their tangents. Among tangents, null means zero, and `one`, from
// which alpha and barycentrics are made, is zero.
struct AttributeArrays {
    const double *vertex, *face, *uvs, one;
};

template <class T>
AttributeArrays attribute_arrays(const SceneView<T>& scene) {
    return {scene.attributes.vertex, scene.attributes.face, scene.uvs, 1};
}
inline AttributeArrays attribute_arrays(const Tangents& t) {
    return {t.vertex_attributes, t.face_attributes, t.uvs, 0};
}

// Calls visit(k, c0, c1, c2) for each attribute k of a face, with its values at the corners.
template <class T, class Visit>
void each_attribute(const SceneView<T>& scene, const AttributeArrays& from, int64_t face, Visit visit) {
    const Attributes& a = scene.attributes;
    int k = 0;
    if (a.alpha) visit(k++, from.one, from.one, from.one);
    if (const int n = a.vertex_width; n > 0) {
        const int32_t* v = scene.faces + 3 * face;
        for (int i = 0; i < n; ++i) {
            const auto at = [&](int corner) { return from.vertex ? from.vertex[int64_t(v[corner]) * n + i] : 0; };
            visit(k++, at(0), at(1), at(2));
        }
    }
    for (int i = 0; i < a.face_width; ++i) {
        const double value = from.face ? from.face[face * a.face_width + i] : 0;
        visit(k++, value, value, value);
    }
    if (a.barycentrics)
        for (int i = 0; i < 3; ++i) visit(k++, i == 0 ? from.one : 0, i == 1 ? from.one : 0, i == 2 ? from.one : 0);
    if (a.uv) {
        const int32_t* row = scene.uv_corners + 3 * face;
        for (int i = 0; i < 2; ++i) {
            const auto at = [&](int corner) { return from.uvs ? from.uvs[2 * int64_t(row[corner]) + i] : 0; };
            visit(k++, at(0), at(1), at(2));
        }
    }
}

// Returns the index of the direction's first channel among the attributes, or −1 if there is none.
inline int direction_of(const Attributes& a) { return a.unit < 0 ? -1 : a.alpha + a.unit; }

template <class T>
void shade_attributes(const SceneView<T>& scene, int64_t face, Barycentrics b, double* out) {
    each_attribute(scene, attribute_arrays(scene), face,
                   [&](int k, double c0, double c1, double c2) { out[k] = c0 + b.u * (c1 - c0) + b.v * (c2 - c0); });
    if (const int d = direction_of(scene.attributes); d >= 0) {
        const Vec3 n = unit({out[d], out[d + 1], out[d + 2]});
        out[d] = n.x, out[d + 1] = n.y, out[d + 2] = n.z;
    }
}

// Returns the interpolated direction before it is normalised.
template <class T>
Vec3 interpolated_direction(const SceneView<T>& scene, int64_t face, Barycentrics b) {
    const int32_t* v = scene.faces + 3 * face;
    Vec3 m;
    for (int i = 0; i < 3; ++i) {
        const double* c =
            scene.attributes.vertex + int64_t(v[i]) * scene.attributes.vertex_width + scene.attributes.unit;
        m += b[i] * Vec3{c[0], c[1], c[2]};
    }
    return m;
}

// Returns the cotangent of the barycentrics, and adds the cotangents of the corner values to `rows` (3, attributes).
template <class T>
Barycentrics shade_attributes_vjp(const SceneView<T>& scene, int64_t face, Barycentrics b, const double* bar,
                                  double* rows) {
    const int n = scene.channels - scene.radiance, d = direction_of(scene.attributes);
    double m_bar[3] = {};
    if (d >= 0) {
        const Vec3 moved = unit_vjp(interpolated_direction(scene, face, b), {bar[d], bar[d + 1], bar[d + 2]});
        m_bar[0] = moved.x, m_bar[1] = moved.y, m_bar[2] = moved.z;
    }
    Barycentrics b_bar;
    each_attribute(scene, attribute_arrays(scene), face, [&](int k, double c0, double c1, double c2) {
        const double own = d >= 0 && k >= d && k < d + 3 ? m_bar[k - d] : bar[k];
        for (int i = 0; i < 3; ++i) rows[i * n + k] += b[i] * own;
        b_bar.u += own * (c1 - c0), b_bar.v += own * (c2 - c0);
    });
    return b_bar;
}

template <class T>
void shade_attributes_jvp(const SceneView<T>& scene, int64_t face, Barycentrics b, Barycentrics b_dot,
                          const Tangents& tangents, double* out) {
    each_attribute(scene, attribute_arrays(scene), face,
                   [&](int k, double c0, double c1, double c2) { out[k] = b_dot.u * (c1 - c0) + b_dot.v * (c2 - c0); });
    each_attribute(scene, attribute_arrays(tangents), face,
                   [&](int k, double c0, double c1, double c2) { out[k] += b[0] * c0 + b[1] * c1 + b[2] * c2; });
    if (const int d = direction_of(scene.attributes); d >= 0) {
        const Vec3 n_dot = unit_vjp(interpolated_direction(scene, face, b), {out[d], out[d + 1], out[d + 2]});
        out[d] = n_dot.x, out[d + 1] = n_dot.y, out[d + 2] = n_dot.z;
    }
}

// Adds the cotangents of a face's corner values, (3, attributes), to the gradients of the arrays.
template <class T>
void add_attribute_rows(const SceneView<T>& scene, int64_t face, const double* rows, const GradientSink& to,
                        LocalGradients& grad) {
    const Attributes& a = scene.attributes;
    const int n = scene.channels - scene.radiance, of_face = a.alpha + a.vertex_width;
    if (to.vertex_attributes)
        for (int i = 0; i < 3; ++i) grad.vertex_attributes.add(scene.faces[3 * face + i], rows + i * n + a.alpha);
    if (to.face_attributes) {
        double sum[Attributes::most_of_face];
        for (int i = 0; i < a.face_width; ++i)
            sum[i] = rows[of_face + i] + rows[n + of_face + i] + rows[2 * n + of_face + i];
        grad.face_attributes.add(face, sum);
    }
    if (to.uvs && a.uv)
        for (int i = 0; i < 3; ++i) grad.uvs.template add<2>(scene.uv_corners[3 * face + i], rows + (i + 1) * n - 2);
}

}  // namespace edgegrad
