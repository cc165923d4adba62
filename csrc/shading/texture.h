// Bilinear lookup in a repeated texture, texel centres at +0.5, row 0 on top while v runs up.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/math.h"

namespace edgegrad {

template <class T>
struct Texture {
    const T* texels;
    int64_t first;  // row of the first texel among all texels
    int64_t height, width;
};

// The four texels around uv, with what is needed of their weights.
struct Footprint {
    int64_t texel[4];
    double a, b;  // fractions to the right and down

    double weight(int i) const { return (i & 1 ? a : 1 - a) * (i & 2 ? b : 1 - b); }
};

template <class T>
Footprint footprint(const Texture<T>& t, Vec2 uv) {
    const double x = uv.x * t.width - 0.5, y = (1 - uv.y) * t.height - 0.5;
    const double fx = std::floor(x), fy = std::floor(y);
    // Reduced in floating point: uv may lie so far out that an integer would overflow.
    const auto wrap = [](double i, int64_t n) {
        const int64_t r = int64_t(i - n * std::floor(i / n));
        return r >= 0 && r < n ? r : 0;  // rounding up to n, or a coordinate beyond the range of doubles
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

// The cotangent of uv; that of texel i is weight(i) · bar.
template <int N, class T>
Vec2 eval_vjp(const Texture<T>& t, const Footprint& f, int channels, const double* bar) {
    const int C = N ? N : channels;
    double s[4] = {};  // bar · texel
    for (int i = 0; i < 4; ++i)
        for (int c = 0; c < C; ++c) s[i] += bar[c] * t.texels[f.texel[i] * C + c];
    const double a_bar = (1 - f.b) * (s[1] - s[0]) + f.b * (s[3] - s[2]);
    const double b_bar = (1 - f.a) * (s[2] - s[0]) + f.a * (s[3] - s[1]);
    return {a_bar * t.width, -b_bar * t.height};
}

// Of one channel's value, for a tangent of uv at fixed texels.
template <class T>
double eval_jvp(const Texture<T>& t, const Footprint& f, int channels, int channel, Vec2 uv_dot) {
    const auto texel = [&](int i) { return double(t.texels[f.texel[i] * channels + channel]); };
    const double a_dot = uv_dot.x * t.width, b_dot = -uv_dot.y * t.height;
    return a_dot * ((1 - f.b) * (texel(1) - texel(0)) + f.b * (texel(3) - texel(2))) +
           b_dot * ((1 - f.a) * (texel(2) - texel(0)) + f.a * (texel(3) - texel(1)));
}

}  // namespace edgegrad
