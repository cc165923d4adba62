// Samples textures bilinearly or at the nearest texel. Texel centres are at +0.5, and row 0 is on top while v runs up.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"
#include "scene/scene.h"

namespace edgegrad {

// Locates the texels of a texture.
struct TexelGrid {
    int64_t first;  // It is the row of the first texel among all texels.
    int64_t height, width;
    Sampler sampler = {};

    // Returns the position in texels, right and down.
    Vec2 place(Vec2 uv) const { return {uv.x * width, (1 - uv.y) * height}; }

    // Returns the next level of a pyramid (pyramid.h), whose texels follow these.
    TexelGrid halved() const {
        return {first + height * width, std::max(int64_t(1), height / 2), std::max(int64_t(1), width / 2), sampler};
    }
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

// Holds the four texels around uv, and the fractions that give their weights.
struct Footprint {
    int64_t texel[4];
    double a, b;  // They are fractions to the right and down.

    double weight(int i) const { return (i & 1 ? a : 1 - a) * (i & 2 ? b : 1 - b); }
};

// Returns the four texels around the corner (i, j) of texels, integers, with the given fractions.
inline Footprint footprint_at(const TexelGrid& t, double i, double j, double a, double b) {
    const auto [u, v, filter] = t.sampler;
    const int64_t i0 = wrapped(i, t.width, u), i1 = wrapped(i + 1, t.width, u);
    const int64_t top = t.first + wrapped(j, t.height, v) * t.width,
                  bottom = t.first + wrapped(j + 1, t.height, v) * t.width;
    return {{top + i0, top + i1, bottom + i0, bottom + i1}, a, b};
}

// Returns the texel (i, j), integers, four times with all the weight; derivatives of the weights then vanish.
inline Footprint texel_at(const TexelGrid& t, double i, double j) {
    const int64_t texel = t.first + wrapped(j, t.height, t.sampler.v) * t.width + wrapped(i, t.width, t.sampler.u);
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
    double s[4] = {};  // It is bar · texel.
    for (int i = 0; i < 4; ++i)
        for (int c = 0; c < C; ++c) s[i] += bar[c] * t.texels[f.texel[i] * C + c];
    const double a_bar = (1 - f.b) * (s[1] - s[0]) + f.b * (s[3] - s[2]);
    const double b_bar = (1 - f.a) * (s[2] - s[0]) + f.a * (s[3] - s[1]);
    return {a_bar * t.width, -b_bar * t.height};
}

// Returns the derivative of one channel's value for a tangent of uv at fixed texels.
template <class T>
double eval_jvp(const Texture<T>& t, const Footprint& f, int channels, int channel, Vec2 uv_dot) {
    const auto texel = [&](int i) { return double(t.texels[f.texel[i] * channels + channel]); };
    const double a_dot = uv_dot.x * t.width, b_dot = -uv_dot.y * t.height;
    return a_dot * ((1 - f.b) * (texel(1) - texel(0)) + f.b * (texel(3) - texel(2))) +
           b_dot * ((1 - f.a) * (texel(2) - texel(0)) + f.a * (texel(3) - texel(1)));
}

}  // namespace edgegrad
