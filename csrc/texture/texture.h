// Samples textures bilinearly or at the nearest texel: which texels a point uses, their weights, and the derivatives.
// Texel centres are at +0.5. Row 0 is on top while v runs up; raster/texels.h has other coordinates.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/dual.h"
#include "core/math.h"

namespace edgegrad {

// Says how an image is sampled. Beyond its border it repeats, clamps to its outermost texels, or is mirrored.
enum class Wrap { repeat, clamp, mirror };
enum class TextureFilter { linear, nearest };
constexpr const char* wrap_names[] = {"repeat", "clamp", "mirror"};
constexpr const char* texture_filter_names[] = {"linear", "nearest"};
struct Sampler {
    Wrap u = Wrap::repeat, v = Wrap::repeat;
    TextureFilter filter = TextureFilter::linear;

    bool operator==(const Sampler&) const = default;
};

// A row of a table of textures has the first texel, height, width, and the sampler's three numbers.
constexpr int texture_columns = 6;

// Returns the height or width of a pyramid's level, where that of the image is n.
constexpr int64_t level_size(int64_t n, int level) { return std::max(int64_t(1), n >> level); }

// Locates the texels of a texture.
struct TexelGrid {
    int64_t first;  // row of the first texel among all texels
    int64_t height, width;
    Sampler sampler = {};

    int64_t at(int64_t column, int64_t row) const { return first + row * width + column; }

    // Returns the position in texels, right and down.
    Vec2 place(Vec2 uv) const { return {uv.x * width, (1 - uv.y) * height}; }

    // Returns the next level of a pyramid (pyramid.h), whose texels follow these.
    TexelGrid halved() const { return {first + height * width, level_size(height, 1), level_size(width, 1), sampler}; }
};

template <class T>
struct Texture : TexelGrid {
    const T* texels;
};

// Returns row `index` of a table of textures.
template <class T>
Texture<T> texture_at(const T* texels, const int64_t* table, int64_t index) {
    const int64_t* row = table + texture_columns * index;
    return {{row[0], row[1], row[2], {Wrap(row[3]), Wrap(row[4]), TextureFilter(row[5])}}, texels};
}

// Returns the texel from 0 to n − 1 at the integer i. The reduction is in floating point, because an integer might
// overflow.
inline int64_t wrapped(double i, int64_t n, Wrap wrap) {
    if (wrap == Wrap::clamp) return int64_t(std::clamp(i, 0.0, double(n - 1)));
    const double period = double(wrap == Wrap::mirror ? 2 * n : n);
    const double r = i - period * std::floor(i / period);
    const int64_t j = r >= 0 && r < period ? int64_t(r) : 0;  // footprint() does the same.
    return j < n ? j : 2 * n - 1 - j;
}

// Returns the bilinear weight of texel i for the fractions a to the right and b down.
template <class S>
S bilinear_weight(int i, S a, S b) {
    return (i & 1 ? a : S(1) - a) * (i & 2 ? b : S(1) - b);
}

// Holds the four texels around a point, and the fractions that give their weights.
struct Footprint {
    int64_t texel[4];
    double a, b;  // fractions to the right and down

    double weight(int i) const { return bilinear_weight(i, a, b); }

    // Returns the value at the point of a number that is s[i] at texel i.
    double interpolate(const double (&s)[4]) const {
        return (1 - b) * ((1 - a) * s[0] + a * s[1]) + b * ((1 - a) * s[2] + a * s[3]);
    }
    // Returns the derivatives of that value by the position in texels, right and down.
    Vec2 slopes(const double (&s)[4]) const {
        return {(1 - b) * (s[1] - s[0]) + b * (s[3] - s[2]), (1 - a) * (s[2] - s[0]) + a * (s[3] - s[1])};
    }
};

// Returns the four texels around the corner (i, j) of texels, integers, with the given fractions.
inline Footprint footprint_at(const TexelGrid& t, double i, double j, double a, double b) {
    const auto [u, v, filter] = t.sampler;
    const int64_t i0 = wrapped(i, t.width, u), i1 = wrapped(i + 1, t.width, u);
    const int64_t j0 = wrapped(j, t.height, v), j1 = wrapped(j + 1, t.height, v);
    return {{t.at(i0, j0), t.at(i1, j0), t.at(i0, j1), t.at(i1, j1)}, a, b};
}

// Returns the texel (i, j), integers, four times with all the weight; derivatives of the weights then vanish.
inline Footprint texel_at(const TexelGrid& t, double i, double j) {
    const int64_t texel = t.at(wrapped(i, t.width, t.sampler.u), wrapped(j, t.height, t.sampler.v));
    return {{texel, texel, texel, texel}, 0, 0};
}

// Handles samplers other than the common one.
Footprint footprint_of_sampler(const TexelGrid& t, Vec2 uv);

inline Footprint footprint(const TexelGrid& t, Vec2 uv) {
    if (t.sampler != Sampler()) [[unlikely]]
        return footprint_of_sampler(t, uv);
    const double x = uv.x * t.width - 0.5, y = (1 - uv.y) * t.height - 0.5;
    const double fx = std::floor(x), fy = std::floor(y);
    // The reduction is in floating point, because an integer might overflow.
    const auto wrap = [](double i, int64_t n) {
        const int64_t r = int64_t(i - n * std::floor(i / n));
        return r >= 0 && r < n ? r : 0;  // Rounding may reach n, or a coordinate may be beyond doubles.
    };
    const int64_t i0 = wrap(fx, t.width), j0 = wrap(fy, t.height);
    const int64_t i1 = i0 + 1 < t.width ? i0 + 1 : 0, j1 = j0 + 1 < t.height ? j0 + 1 : 0;
    const int64_t top = t.first + j0 * t.width, bottom = t.first + j1 * t.width;
    return {{top + i0, top + i1, bottom + i0, bottom + i1}, x - fx, y - fy};
}

// Returns a fraction between texels. Its derivative is the coordinate's derivative times the number of texels.
inline double fraction(double value, double, double) { return value; }
inline Dual fraction(double value, Dual coordinate, double texels) { return {value, texels * coordinate.dot}; }

// Calls visit(texel, its weight) for the four texels around (u, v). Weights are Dual where the coordinates are.
template <class S, class Visit>
void each_texel(const TexelGrid& t, S u, S v, Visit visit) {
    const Footprint f = footprint(t, {plain(u), plain(v)});
    const bool moves = t.sampler.filter == TextureFilter::linear;
    const S a = fraction(f.a, u, moves ? double(t.width) : 0), b = fraction(f.b, v, moves ? -double(t.height) : 0);
    for (int i = 0; i < 4; ++i) visit(f.texel[i], bilinear_weight(i, a, b));
}

template <int N, class T>
void eval(const Texture<T>& t, const Footprint& f, int channels, double* out) {
    const int C = N ? N : channels;
    for (int c = 0; c < C; ++c) out[c] = 0;
    for (int i = 0; i < 4; ++i) {
        const double w = f.weight(i);
        const T* texel = t.texels + f.texel[i] * C;
        for (int c = 0; c < C; ++c) out[c] += w * texel[c];
    }
}

// Returns the cotangent of uv; that of texel i is weight(i) · bar.
template <int N, class T>
Vec2 eval_vjp(const Texture<T>& t, const Footprint& f, int channels, const double* bar) {
    const int C = N ? N : channels;
    double s[4] = {};  // bar · texel
    for (int i = 0; i < 4; ++i)
        for (int c = 0; c < C; ++c) s[i] += bar[c] * t.texels[f.texel[i] * C + c];
    const Vec2 slopes = f.slopes(s);
    return {slopes.x * t.width, -slopes.y * t.height};
}

// Returns the derivative of one channel's value for a tangent of uv at fixed texels.
template <class T>
double eval_jvp(const Texture<T>& t, const Footprint& f, int channels, int channel, Vec2 uv_dot) {
    double s[4];
    for (int i = 0; i < 4; ++i) s[i] = double(t.texels[f.texel[i] * channels + channel]);
    const Vec2 slopes = f.slopes(s);
    const double a_dot = uv_dot.x * t.width, b_dot = -uv_dot.y * t.height;
    return a_dot * slopes.x + b_dot * slopes.y;
}

}  // namespace edgegrad
