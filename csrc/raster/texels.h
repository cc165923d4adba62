// Finds the texels and weights of a lookup in a texture or a cube map. Texel (0, 0) is at the origin of texture
// coordinates, and texel centres are at +0.5. The sides of a cube and their axes are OpenGL's.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"

namespace edgegrad {

enum class Border { wrap, clamp, zero, cube };

// Describes levels of halves, one after the other. Each has all images' textures with their sides, row by row.
struct TextureShape {
    int64_t images;  // 1 means that all images share the texture.
    int64_t height, width;
    int channels, levels;
    Border border;

    int sides() const { return border == Border::cube ? 6 : 1; }
    int64_t rows(int level) const { return std::max<int64_t>(1, height >> level); }
    int64_t columns(int level) const { return std::max<int64_t>(1, width >> level); }
    int64_t texels(int level) const { return images * sides() * rows(level) * columns(level); }
    int64_t first(int level) const {
        int64_t n = 0;
        for (int k = 0; k < level; ++k) n += texels(k);
        return n;
    }
    int64_t all_texels() const { return first(levels); }
};

// Locates one image's texture in one level.
struct TexelPlane {
    int64_t first, height, width;

    TexelPlane(const TextureShape& t, int64_t image, int level)
        : first(t.first(level) + (t.images > 1 ? image : 0) * t.sides() * t.rows(level) * t.columns(level)),
          height(t.rows(level)),
          width(t.columns(level)) {}
    int64_t at(int side, int64_t x, int64_t y) const { return first + (side * height + y) * width + x; }
};

// Locates a point in a texture, or on a side of a cube; s and t are fractions of its width and height.
struct TexturePlace {
    int side = 0;
    double s, t;
};

// Holds up to four texels, −1 where there is none, with weights and their changes per texel to the right and up.
struct Taps {
    int64_t texel[4];
    double weight[4], by_x[4], by_y[4];
};

// Holds the axes of a cube's sides: the major one with its sign, and those along which s and t run.
struct CubeFace {
    int major, s, t;
    double sign, s_sign, t_sign;
};
inline constexpr CubeFace cube_faces[6] = {{0, 2, 1, 1, -1, -1}, {0, 2, 1, -1, 1, -1}, {1, 0, 2, 1, 1, 1},
                                           {1, 0, 2, -1, 1, -1}, {2, 0, 1, 1, 1, -1},  {2, 0, 1, -1, -1, -1}};

// Returns the side of a direction, or −1 for directions that are zero or not finite.
inline int cube_face_of(const double (&d)[3]) {
    int axis = 0;
    for (int k = 0; k < 3; ++k) {
        if (!std::isfinite(d[k])) return -1;
        if (std::fabs(d[k]) > std::fabs(d[axis])) axis = k;
    }
    if (d[axis] == 0) return -1;
    return 2 * axis + (d[axis] < 0);
}

// Returns the texel (x, y) of a side of n by n, or beyond an edge, the adjacent texel on the next side. Centres are at
// odd numbers in a cube from −n to n. A coordinate that leaves the cube becomes that of the next side, and the side's
// own coordinate that of its outermost texels. Returns −1 beyond a corner, where three sides meet.
inline int64_t cube_texel(const TexelPlane& plane, int side, int64_t x, int64_t y) {
    const int64_t n = plane.width;
    const bool over_x = x < 0 || x >= n, over_y = y < 0 || y >= n;
    if (!over_x && !over_y) return plane.at(side, x, y);
    if (over_x && over_y) return -1;
    const CubeFace& from = cube_faces[side];
    int64_t place[3];
    place[from.s] = int64_t(from.s_sign) * (2 * x + 1 - n), place[from.t] = int64_t(from.t_sign) * (2 * y + 1 - n);
    const int over = over_x ? from.s : from.t;
    place[from.major] = int64_t(from.sign) * (n - 1);
    const int next = 2 * over + (place[over] < 0);
    const CubeFace& to = cube_faces[next];
    return plane.at(next, (int64_t(to.s_sign) * place[to.s] + n - 1) / 2,
                    (int64_t(to.t_sign) * place[to.t] + n - 1) / 2);
}

// Holds one coordinate as two texels, the weight of the second, and its derivative by the coordinate.
struct Steps {
    int64_t i0, i1;  // −1 means outside.
    double share, slope;
};
inline Steps steps(double s, int64_t n, Border border) {
    if (border == Border::wrap) s -= std::floor(s);
    double x = s * double(n) - 0.5, slope = 1;
    if (border == Border::clamp && !(x >= 0 && x <= double(n - 1))) x = std::clamp(x, 0.0, double(n - 1)), slope = 0;
    x = std::clamp(x, -2.0, double(n) + 1);  // An integer might overflow beyond this, and nothing is there.
    const double floor = std::floor(x);
    Steps out{int64_t(floor), int64_t(floor) + 1, x - floor, slope};
    if (border == Border::wrap) {
        if (out.i0 < 0) out.i0 = n - 1;
        if (out.i1 >= n) out.i1 = 0;
    } else if (border == Border::clamp) {
        out.i1 = std::min(out.i1, n - 1);
    } else if (border == Border::zero) {
        if (out.i0 < 0 || out.i0 >= n) out.i0 = -1;
        if (out.i1 < 0 || out.i1 >= n) out.i1 = -1;
    }
    return out;
}

inline Taps linear_taps(const TexelPlane& plane, const TexturePlace& at, Border border) {
    const Steps x = steps(at.s, plane.width, border), y = steps(at.t, plane.height, border);
    const double a = x.share, b = y.share;
    Taps out{{},
             {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b},
             {-(1 - b) * x.slope, (1 - b) * x.slope, -b * x.slope, b * x.slope},
             {-(1 - a) * y.slope, -a * y.slope, (1 - a) * y.slope, a * y.slope}};
    if (border != Border::cube) {
        const int64_t column[2] = {x.i0, x.i1}, row[2] = {y.i0, y.i1};
        for (int k = 0; k < 4; ++k) {
            const int64_t i = column[k & 1], j = row[k >> 1];
            out.texel[k] = i < 0 || j < 0 ? -1 : plane.at(0, i, j);
        }
        return out;
    }
    int corner = -1;
    for (int k = 0; k < 4; ++k) {
        out.texel[k] = cube_texel(plane, at.side, k & 1 ? x.i1 : x.i0, k & 2 ? y.i1 : y.i0);
        if (out.texel[k] < 0) corner = k;
    }
    if (corner < 0) return out;
    // The missing texel is the mean of the three that meet there, seen from any side.
    for (int k = 0; k < 4; ++k) {
        if (k == corner) continue;
        out.weight[k] += out.weight[corner] / 3;
        out.by_x[k] += out.by_x[corner] / 3, out.by_y[k] += out.by_y[corner] / 3;
    }
    return out;
}

// Returns the texel that contains a point, or −1.
inline int64_t nearest_texel(const TexelPlane& plane, const TexturePlace& at, Border border) {
    const auto cell = [&](double s, int64_t n) {
        if (border == Border::wrap) s -= std::floor(s);
        const double x = std::floor(s * double(n));
        if (border == Border::zero && !(x >= 0 && x < double(n))) return int64_t(-1);
        return int64_t(std::clamp(x, 0.0, double(n - 1)));
    };
    const int64_t x = cell(at.s, plane.width), y = cell(at.t, plane.height);
    return x < 0 || y < 0 ? -1 : plane.at(at.side, x, y);
}

}  // namespace edgegrad
