// Reads material parameters, and implements the _vjp. They are constants, arrays over vertices, faces or corners, or
// textures.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "shading/lit/tables.h"
#include "texture/pyramid_level.h"
#include "texture/texture.h"

namespace edgegrad {

struct Source {
    enum class Kind { constant, vertex, face, corner, texture };
    Kind kind = Kind::constant;
    int value = no_table;  // Without a table the parameter does not exist.
    // Textures have coordinates, an optional factor, the corners' rows of coordinates, and an image.
    int uvs = no_table, factor = no_table;
    const int32_t* uv_faces = nullptr;
    int64_t height = 0, width = 0;
    Sampler sampler = {};
    int levels = 1;  // number of levels of the image's pyramid (pyramid.h)

    bool exists() const { return value != no_table; }
    // Returns whether the footprint of a pixel selects the level.
    template <class Point>
    bool is_filtered(const Point& at) const {
        return levels > 1 && at.spread;
    }
    // Returns the grid of one level; the table holds the texels level after level.
    TexelGrid grid(int level = 0) const {
        TexelGrid o{0, height, width, sampler};
        for (; level > 0; --level) o = o.halved();
        return o;
    }
};

// Counts the differences of the last two barycentrics between neighbouring pixels: (2,) to the right and (2,) down.
constexpr int spread_size = 4;

// Identifies a point on a face of a mesh.
template <class S>
struct FacePoint {
    int64_t face;               // number among the mesh's own faces
    const int32_t* vertex;      // (3,) vertices of the scene
    int32_t first_vertex;       // first vertex of the mesh
    S b[3];                     // barycentrics
    const S* spread = nullptr;  // Null means unknown; textures are then looked up unfiltered.
    int64_t row(int i) const { return vertex[i] - first_vertex; }
};

// Holds the cotangents of a point's barycentrics and of their spread.
struct FacePointBar {
    double b[3] = {}, spread[spread_size] = {};
};

// Holds the texture coordinates of a corner or a point.
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

// Selects the level of a pyramid (Williams 1983): log2 of the distance between neighbouring pixels in texels. The
// larger distance of both directions counts. edgegrad/points/footprints.py does the same.
template <class S>
struct MipLevel : PyramidLevel<S> {
    int axis = 0;            // direction with the larger distance
    S across = 0, down = 0;  // larger distance in texels
};
template <class S>
MipLevel<S> level_of(const std::vector<Table>& tables, const Source& source, const FacePoint<S>& at) {
    Uv<S> corner[3];
    for (int i = 0; i < 3; ++i) corner[i] = corner_uv<S>(tables, source, at.face, i);
    S across[2], down[2], squared[2];
    for (int axis = 0; axis < 2; ++axis) {
        const S u = at.spread[2 * axis], v = at.spread[2 * axis + 1];
        across[axis] = S(double(source.width)) * (u * (corner[1].u - corner[0].u) + v * (corner[2].u - corner[0].u));
        down[axis] = S(double(source.height)) * (u * (corner[1].v - corner[0].v) + v * (corner[2].v - corner[0].v));
        squared[axis] = across[axis] * across[axis] + down[axis] * down[axis];
    }
    // NaN counts as the larger distance here, and as no distance below.
    const int axis = plain(squared[1]) > plain(squared[0]) || std::isnan(plain(squared[1])) ? 1 : 0;
    MipLevel<S> o;
    if (!(plain(squared[axis]) > 1)) return o;
    return {{S(0.5) * log2(squared[axis]), source.levels}, axis, across[axis], down[axis]};
}
// Adds the cotangents of `share`.
inline void level_vjp(const std::vector<Table>& tables, const Source& source, const FacePoint<double>& at,
                      const MipLevel<double>& o, double bar, FacePointBar& at_bar, Cotangents& to) {
    const double scale = bar / (M_LN2 * (o.across * o.across + o.down * o.down));
    const double u_bar = scale * o.across * source.width, v_bar = scale * o.down * source.height;
    const Uv<double> first = corner_uv<double>(tables, source, at.face, 0);
    double first_bar[2] = {};
    for (int i = 0; i < 2; ++i) {
        const int64_t row = source.uv_faces[3 * at.face + i + 1];
        const Uv<double> corner = corner_uv<double>(tables, source, at.face, i + 1);
        at_bar.spread[2 * o.axis + i] += u_bar * (corner.u - first.u) + v_bar * (corner.v - first.v);
        const double spread = at.spread[2 * o.axis + i], corner_bar[2] = {spread * u_bar, spread * v_bar};
        to.add(source.uvs, row, corner_bar);
        first_bar[0] -= corner_bar[0], first_bar[1] -= corner_bar[1];
    }
    to.add(source.uvs, source.uv_faces[3 * at.face], first_bar);
}

// Calls visit(row of the table, its weight) for the rows whose weighted sum is the value.
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
            if (!source.is_filtered(at)) return each_texel(source.grid(), uv.u, uv.v, visit);
            level_of(tables, source, at).each([&](int level, S share) {
                each_texel(source.grid(level), uv.u, uv.v, [&](int64_t row, S weight) { visit(row, share * weight); });
            });
        }
    }
}

// Writes `channels` numbers; a table of width 1 serves all channels.
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

// Adds to the cotangents of the point and of the tables.
inline void value_vjp(const std::vector<Table>& tables, const Source& source, const FacePoint<double>& at, int channels,
                      const double* bar, FacePointBar& at_bar, Cotangents& to) {
    const Table& table = tables[source.value];
    const int n = table.width == 1 ? 1 : channels;
    double own[most_lit_channels];  // cotangent of the value before the factor
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
    double row_bar[most_lit_channels], s[4];  // `s` holds bar · texel.
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
            for (int i = 0; i < 3; ++i) at_bar.b[i] += s[i];
        return;
    }
    const Uv<double> uv = interpolated_uv(tables, source, at);
    double u_bar = 0, v_bar = 0;
    // Returns bar · value of one image, which enters the value with the weight `share`.
    const auto look_up_vjp = [&](const TexelGrid& grid, double share) {
        const Footprint f = footprint(grid, {uv.u, uv.v});
        k = 0;
        for (int i = 0; i < 4; ++i) add(f.texel[i], share * f.weight(i));
        const Vec2 slopes = f.slopes(s);
        u_bar += share * (grid.width * slopes.x), v_bar += share * (-double(grid.height) * slopes.y);
        return f.interpolate(s);
    };
    if (source.is_filtered(at)) {
        const MipLevel<double> level = level_of(tables, source, at);
        const double fine = look_up_vjp(source.grid(level.fine), 1 - level.share);
        if (level.is_between) {
            const double coarse = look_up_vjp(source.grid(level.fine + 1), level.share);
            level_vjp(tables, source, at, level, coarse - fine, at_bar, to);
        }
    } else {
        look_up_vjp(source.grid(), 1);
    }
    if (source.sampler.filter != TextureFilter::linear) return;
    for (int i = 0; i < 3; ++i) {
        const Uv<double> corner = corner_uv<double>(tables, source, at.face, i);
        at_bar.b[i] += u_bar * corner.u + v_bar * corner.v;
        const double uv_bar[2] = {at.b[i] * u_bar, at.b[i] * v_bar};
        to.add(source.uvs, source.uv_faces[3 * at.face + i], uv_bar);
    }
}

}  // namespace edgegrad
