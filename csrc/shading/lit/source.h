// Where a parameter of a material comes from: a constant, numbers of vertices, faces or corners, or a texture. Value,
// and beneath it the _vjp.
#pragma once

#include <cstdint>

#include "shading/lit/tables.h"
#include "shading/texture.h"

namespace edgegrad {

struct Source {
    enum class Kind { constant, vertex, face, corner, texture };
    Kind kind = Kind::constant;
    int value = no_table;  // none: there is no such parameter
    // Of textures: coordinates, a factor if there is one, rows of coordinates by the corners of faces, and the image.
    int uvs = no_table, factor = no_table;
    const int32_t* uv_faces = nullptr;
    int64_t height = 0, width = 0;
    Sampler sampler = {};

    bool exists() const { return value != no_table; }
    // The texels are rows of the table.
    TexelGrid grid() const { return {0, height, width, sampler}; }
};

// A point on a face of a mesh.
template <class S>
struct FacePoint {
    int64_t face;           // as the mesh counts its own
    const int32_t* vertex;  // (3,) as the scene counts them
    int32_t first_vertex;   // of the mesh
    S b[3];                 // barycentrics
    int64_t row(int i) const { return vertex[i] - first_vertex; }
};

// The texture coordinates of a corner.
template <class S>
struct Uv {
    S u = 0, v = 0;
};
template <class S>
Uv<S> corner_uv(const std::vector<Table>& tables, const Source& source, int64_t face, int corner) {
    const int64_t row = source.uv_faces[3 * face + corner];
    return {tables[source.uvs].at<S>(row, 0), tables[source.uvs].at<S>(row, 1)};
}
template <class S>
Uv<S> interpolated_uv(const std::vector<Table>& tables, const Source& source, const FacePoint<S>& at) {
    Uv<S> uv;
    for (int i = 0; i < 3; ++i) {
        const Uv<S> corner = corner_uv<S>(tables, source, at.face, i);
        uv.u += at.b[i] * corner.u, uv.v += at.b[i] * corner.v;
    }
    return uv;
}
inline Footprint footprint(const Source& source, Vec2 uv) { return footprint(source.grid(), uv); }

// A fraction between texels, whose derivative is that of the coordinate times the texels in it.
inline double fraction(double value, double, double) { return value; }
inline Dual fraction(double value, Dual coordinate, double texels) { return {value, texels * coordinate.dot}; }

template <class S, class Visit>
void each_texel(const Footprint& f, S a, S b, Visit visit) {
    visit(f.texel[0], (S(1) - a) * (S(1) - b)), visit(f.texel[1], a * (S(1) - b));
    visit(f.texel[2], (S(1) - a) * b), visit(f.texel[3], a * b);
}

// Calls visit(row of the table, its weight) for the rows whose weighted sum the value is.
template <class S, class Visit>
void each_row(const std::vector<Table>& tables, const Source& source, const FacePoint<S>& at, Visit visit) {
    switch (source.kind) {
        case Source::Kind::constant:
            return visit(0, S(1));
        case Source::Kind::face:
            return visit(at.face, S(1));
        case Source::Kind::vertex:
        case Source::Kind::corner:
            for (int i = 0; i < 3; ++i)
                visit(source.kind == Source::Kind::vertex ? at.row(i) : 3 * at.face + i, at.b[i]);
            return;
        case Source::Kind::texture: {
            const Uv<S> uv = interpolated_uv(tables, source, at);
            const Footprint f = footprint(source, {plain(uv.u), plain(uv.v)});
            const bool moves = source.sampler.filter == TextureFilter::linear;
            const S a = fraction(f.a, uv.u, moves ? double(source.width) : 0),
                    b = fraction(f.b, uv.v, moves ? -double(source.height) : 0);
            each_texel(f, a, b, visit);
        }
    }
}

// Of `channels` numbers, or of one for all of them.
template <class S>
void value(const std::vector<Table>& tables, const Source& source, const FacePoint<S>& at, int channels, S* out) {
    const Table& table = tables[source.value];
    const int n = table.width == 1 ? 1 : channels;
    for (int c = 0; c < n; ++c) out[c] = 0;
    each_row(tables, source, at, [&](int64_t row, S weight) {
        for (int c = 0; c < n; ++c) out[c] += weight * table.at<S>(row, c);
    });
    for (int c = n; c < channels; ++c) out[c] = out[0];
    if (source.factor != no_table)
        for (int c = 0; c < channels; ++c) out[c] *= tables[source.factor].channel<S>(0, c);
}

// Adds the cotangent of the barycentrics to b_bar (3,).
inline void value_vjp(const std::vector<Table>& tables, const Source& source, const FacePoint<double>& at, int channels,
                      const double* bar, double* b_bar, Cotangents& to) {
    const Table& table = tables[source.value];
    const int n = table.width == 1 ? 1 : channels;
    double own[most_lit_channels];  // that of the value before the factor
    if (source.factor != no_table) {
        const Table& factor = tables[source.factor];
        Source plain_source = source;
        plain_source.factor = no_table;
        double before[most_lit_channels], factor_bar[most_lit_channels];
        value(tables, plain_source, at, channels, before);
        for (int c = 0; c < channels; ++c)
            factor_bar[c] = bar[c] * before[c], own[c] = bar[c] * factor.channel<double>(0, c);
        to.add_channels(source.factor, 0, factor.width, channels, factor_bar);
    } else {
        for (int c = 0; c < channels; ++c) own[c] = bar[c];
    }
    if (n < channels)
        for (int c = 1; c < channels; ++c) own[0] += own[c];
    double row_bar[most_lit_channels], s[4];  // of the texels: bar · texel
    int k = 0;
    const auto add = [&](int64_t row, double weight) {
        double sum = 0;
        for (int c = 0; c < n; ++c) row_bar[c] = weight * own[c], sum += own[c] * table.at<double>(row, c);
        to.add(source.value, row, row_bar);
        s[k++] = sum;
    };
    if (source.kind != Source::Kind::texture) {
        each_row<double>(tables, source, at, add);
        if (source.kind == Source::Kind::vertex || source.kind == Source::Kind::corner)
            for (int i = 0; i < 3; ++i) b_bar[i] += s[i];
        return;
    }
    const Uv<double> uv = interpolated_uv(tables, source, at);
    const Footprint f = footprint(source, {uv.u, uv.v});
    each_texel<double>(f, f.a, f.b, add);
    if (source.sampler.filter != TextureFilter::linear) return;
    const double u_bar = source.width * ((1 - f.b) * (s[1] - s[0]) + f.b * (s[3] - s[2])),
                 v_bar = -double(source.height) * ((1 - f.a) * (s[2] - s[0]) + f.a * (s[3] - s[1]));
    for (int i = 0; i < 3; ++i) {
        const Uv<double> corner = corner_uv<double>(tables, source, at.face, i);
        b_bar[i] += u_bar * corner.u + v_bar * corner.v;
        const double uv_bar[2] = {at.b[i] * u_bar, at.b[i] * v_bar};
        to.add(source.uvs, source.uv_faces[3 * at.face + i], uv_bar);
    }
}

}  // namespace edgegrad
