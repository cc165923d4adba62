// Finds the texels of a lookup in a texture or a cube map; texture/texture.h has their weights. Unlike there, texel (0,
// 0) is at the origin of texture coordinates, as in nvdiffrast. The sides of a cube and their axes are OpenGL's.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"
#include "texture/texture.h"

namespace edgegrad {

// Says how coordinates continue beyond a border, as nvdiffrast does. Unlike Wrap, `wrap` subtracts whole periods before
// coordinates are scaled to texels, and `clamp` clamps coordinates rather than texels.
enum class BoundaryMode { wrap, clamp, zero, cube };

// Describes levels of halves, one after the other. Each has all images' textures with their sides, row by row.
struct TextureShape {
    int64_t images;  // 1 means that all images share the texture.
    int64_t height, width;
    int channels, levels;
    BoundaryMode boundary_mode;

    int sides() const { return boundary_mode == BoundaryMode::cube ? 6 : 1; }
    int64_t rows(int level) const { return level_size(height, level); }
    int64_t columns(int level) const { return level_size(width, level); }
    int64_t texels(int level) const { return images * sides() * rows(level) * columns(level); }
    int64_t first(int level) const {
        int64_t n = 0;
        for (int k = 0; k < level; ++k) n += texels(k);
        return n;
    }
    int64_t all_texels() const { return first(levels); }

    // Locates one image's texture in one level; the sides of a cube lie below one another.
    TexelGrid grid(int64_t image, int level) const {
        const int64_t own = sides() * rows(level) * columns(level);
        return {first(level) + (images > 1 ? image : 0) * own, rows(level), columns(level)};
    }
};
inline int64_t texel_of_side(const TexelGrid& grid, int side, int64_t x, int64_t y) {
    return grid.at(x, side * grid.height + y);
}

// Locates a point in a texture, or on a side of a cube; s and t are fractions of its width and height.
struct TexturePlace {
    int side = 0;
    double s, t;
};

// Holds up to four texels, −1 where there is none. Where three sides of a cube meet, the missing texel is the mean of
// the other three, seen from any side.
struct BorderedFootprint : Footprint {
    Vec2 moves;       // 0 along axes where the coordinate is clamped, otherwise 1
    int corner = -1;  // missing texel of the four

    // Returns the weight of a texel that is there.
    double weight(int i) const {
        const double own = Footprint::weight(i);
        return corner < 0 ? own : own + Footprint::weight(corner) / 3;
    }
    // Sets the missing number of four at the texels.
    void fill_corner(double (&s)[4]) const {
        if (corner >= 0) s[corner] = 0, s[corner] = (s[0] + s[1] + s[2] + s[3]) / 3;
    }
};

// Holds the axes of a cube's sides: the major one with its sign, and those along which s and t run.
struct SideAxes {
    int major, s, t;
    double sign, s_sign, t_sign;
};
inline constexpr SideAxes side_axes[6] = {{0, 2, 1, 1, -1, -1}, {0, 2, 1, -1, 1, -1}, {1, 0, 2, 1, 1, 1},
                                          {1, 0, 2, -1, 1, -1}, {2, 0, 1, 1, 1, -1},  {2, 0, 1, -1, -1, -1}};

// Returns the side of a direction, or −1 for directions that are zero or not finite.
inline int side_of(const double (&d)[3]) {
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
inline int64_t cube_texel(const TexelGrid& grid, int side, int64_t x, int64_t y) {
    const int64_t n = grid.width;
    const bool over_x = x < 0 || x >= n, over_y = y < 0 || y >= n;
    if (!over_x && !over_y) return texel_of_side(grid, side, x, y);
    if (over_x && over_y) return -1;
    const SideAxes& from = side_axes[side];
    int64_t place[3];
    place[from.s] = int64_t(from.s_sign) * (2 * x + 1 - n), place[from.t] = int64_t(from.t_sign) * (2 * y + 1 - n);
    const int over = over_x ? from.s : from.t;
    place[from.major] = int64_t(from.sign) * (n - 1);
    const int next = 2 * over + (place[over] < 0);
    const SideAxes& to = side_axes[next];
    return texel_of_side(grid, next, (int64_t(to.s_sign) * place[to.s] + n - 1) / 2,
                         (int64_t(to.t_sign) * place[to.t] + n - 1) / 2);
}

// Holds one coordinate as two texels, the weight of the second, and its derivative by the position in texels.
struct LinearTexels {
    int64_t i0, i1;  // −1 means outside.
    double share, slope;
};
inline LinearTexels linear_texels(double s, int64_t n, BoundaryMode boundary_mode) {
    if (boundary_mode == BoundaryMode::wrap) s -= std::floor(s);
    double x = s * double(n) - 0.5, slope = 1;
    if (boundary_mode == BoundaryMode::clamp && !(x >= 0 && x <= double(n - 1)))
        x = std::clamp(x, 0.0, double(n - 1)), slope = 0;
    x = std::clamp(x, -2.0, double(n) + 1);  // An integer might overflow beyond this, and nothing is there.
    const double floor = std::floor(x);
    LinearTexels out{int64_t(floor), int64_t(floor) + 1, x - floor, slope};
    if (boundary_mode == BoundaryMode::wrap) {
        if (out.i0 < 0) out.i0 = n - 1;
        if (out.i1 >= n) out.i1 = 0;
    } else if (boundary_mode == BoundaryMode::clamp) {
        out.i1 = std::min(out.i1, n - 1);
    } else if (boundary_mode == BoundaryMode::zero) {
        if (out.i0 < 0 || out.i0 >= n) out.i0 = -1;
        if (out.i1 < 0 || out.i1 >= n) out.i1 = -1;
    }
    return out;
}

inline BorderedFootprint footprint(const TexelGrid& grid, const TexturePlace& at, BoundaryMode boundary_mode) {
    const LinearTexels x = linear_texels(at.s, grid.width, boundary_mode),
                       y = linear_texels(at.t, grid.height, boundary_mode);
    BorderedFootprint out{{{}, x.share, y.share}, {x.slope, y.slope}};
    for (int k = 0; k < 4; ++k) {
        const int64_t i = k & 1 ? x.i1 : x.i0, j = k & 2 ? y.i1 : y.i0;
        if (boundary_mode != BoundaryMode::cube) {
            out.texel[k] = i < 0 || j < 0 ? -1 : grid.at(i, j);
        } else {
            out.texel[k] = cube_texel(grid, at.side, i, j);
            if (out.texel[k] < 0) out.corner = k;
        }
    }
    return out;
}

// Returns the texel that contains a point, or −1.
inline int64_t nearest_texel(const TexelGrid& grid, const TexturePlace& at, BoundaryMode boundary_mode) {
    const auto cell = [&](double s, int64_t n) {
        if (boundary_mode == BoundaryMode::wrap) s -= std::floor(s);
        const double x = std::floor(s * double(n));
        if (boundary_mode == BoundaryMode::zero && !(x >= 0 && x < double(n))) return int64_t(-1);
        return int64_t(std::clamp(x, 0.0, double(n - 1)));
    };
    const int64_t x = cell(at.s, grid.width), y = cell(at.t, grid.height);
    return x < 0 || y < 0 ? -1 : texel_of_side(grid, at.side, x, y);
}

}  // namespace edgegrad
