#include "raster/sample_texture.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/channels.h"
#include "raster/sums.h"
#include "raster/texture_level.h"

namespace edgegrad {

namespace {

// What one pixel takes of a pyramid: the share of the second of two levels, and whether that moves.
struct Levels {
    int below = 0, above = 0;
    double share = 0;
    bool moves = false;
};

template <class T>
class PixelLookUp {
   public:
    PixelLookUp(const TextureInput<T>& in, int64_t pixel) : in_(in) {
        const int n = in.coordinates();
        for (int k = 0; k < n; ++k) uv_.at[k] = double(in.uv[n * pixel + k]);
        valid_ = place_of(uv_, in.shape.border, place_);
        if (!valid_ || in.look_up == LookUp::nearest || in.look_up == LookUp::linear) return;
        double level = 0;
        if (in.uv_da) {
            for (int k = 0; k < 2 * n; ++k) uv_.by_pixel[k] = double(in.uv_da[2 * n * pixel + k]);
            level = LongAxis(texels_a_pixel(uv_, in.shape, place_)).level;
        }
        if (in.bias) level += double(in.bias[pixel]);
        const double top = in.shape.levels - 1;
        const bool inside = level > 0 && level < top;
        level = level >= top ? top : level > 0 ? level : 0;  // −∞ and what is no number: the texture itself
        if (in.look_up == LookUp::linear_nearest_level) {
            levels_.below = levels_.above = int(std::floor(level + 0.5));
            return;
        }
        levels_.below = int(std::floor(level)), levels_.above = std::min(levels_.below + 1, in.shape.levels - 1);
        levels_.share = level - levels_.below, levels_.moves = inside;
    }
    bool valid() const { return valid_; }

    // visit(level, weight) of those that count; of both where the level moves.
    template <class Visit>
    void each_level(Visit visit) const {
        visit(levels_.below, 1 - levels_.share);
        if (levels_.share > 0 || levels_.moves) visit(levels_.above, levels_.share);
    }
    int64_t nearest(const TexelPlane& plane) const { return nearest_texel(plane, place_, in_.shape.border); }
    Taps taps(const TexelPlane& plane) const { return linear_taps(plane, place_, in_.shape.border); }

    // From the cotangents of s and t and of the level.
    void vjp(Vec2 place_bar, double level_bar, TextureCoordinates& uv_bar) const {
        place_vjp(uv_, in_.shape.border, place_, place_bar, uv_bar);
        if (!levels_.moves || !in_.uv_da || level_bar == 0) return;
        const Mat2 jacobian = texels_a_pixel(uv_, in_.shape, place_);
        const Mat2 bar = long_axis_vjp(jacobian, LongAxis(jacobian), level_bar);
        texels_a_pixel_vjp(uv_, in_.shape, place_, bar, uv_bar);
    }
    const Levels& levels() const { return levels_; }

   private:
    const TextureInput<T>& in_;
    TextureCoordinates uv_;
    TexturePlace place_;
    bool valid_;
    Levels levels_;
};

// Levels of the texture of one image.
std::vector<TexelPlane> planes_of(const TextureShape& shape, int64_t image) {
    std::vector<TexelPlane> out;
    for (int level = 0; level < shape.levels; ++level) out.emplace_back(shape, image, level);
    return out;
}

template <int N, class T>
void sample_pixel(const TextureInput<T>& in, const std::vector<TexelPlane>& planes, int64_t pixel, T* to) {
    const int C = N > 0 ? N : in.shape.channels;
    const PixelLookUp<T> at(in, pixel);
    if (!at.valid()) {
        std::fill_n(to, C, T(0));
        return;
    }
    if (in.look_up == LookUp::nearest) {
        const int64_t texel = at.nearest(planes[0]);
        for (int c = 0; c < C; ++c) to[c] = texel < 0 ? T(0) : in.texels[texel * C + c];
        return;
    }
    double fixed[N > 0 ? N : 1] = {};
    std::vector<double> many(N > 0 ? 0 : C, 0.0);
    double* sum = N > 0 ? fixed : many.data();
    at.each_level([&](int level, double weight) {
        const Taps taps = at.taps(planes[level]);
        for (int k = 0; k < 4; ++k) {
            if (taps.texel[k] < 0) continue;
            const T* texel = in.texels + taps.texel[k] * C;
            const double w = weight * taps.weight[k];
            for (int c = 0; c < C; ++c) sum[c] += w * double(texel[c]);
        }
    });
    for (int c = 0; c < C; ++c) to[c] = T(sum[c]);
}

template <class T, int N>
void coordinates_vjp(const TextureInput<T>& in, const std::vector<TexelPlane>& planes, int64_t pixel, const T* bar,
                     TextureWanted wanted, TextureGrad<T>& out) {
    const int C = N > 0 ? N : in.shape.channels, n = in.coordinates();
    TextureCoordinates uv_bar;
    double level_bar = 0;
    const PixelLookUp<T> at(in, pixel);
    if (at.valid() && in.look_up != LookUp::nearest) {
        Vec2 place_bar;
        double value[2] = {};  // bar · what each level shows
        int index = 0;
        at.each_level([&](int level, double weight) {
            const TexelPlane& plane = planes[level];
            const Taps taps = at.taps(plane);
            double by_x = 0, by_y = 0;
            for (int k = 0; k < 4; ++k) {
                if (taps.texel[k] < 0) continue;
                const T* texel = in.texels + taps.texel[k] * C;
                double s = 0;
                for (int c = 0; c < C; ++c) s += double(bar[c]) * double(texel[c]);
                by_x += taps.by_x[k] * s, by_y += taps.by_y[k] * s, value[index] += taps.weight[k] * s;
            }
            place_bar += Vec2{weight * by_x * double(plane.width), weight * by_y * double(plane.height)};
            ++index;
        });
        if (at.levels().moves) level_bar = value[1] - value[0];
        at.vjp(place_bar, level_bar, uv_bar);
    }
    if (wanted.uv)
        for (int k = 0; k < n; ++k) (*out.uv)[n * pixel + k] = T(uv_bar.at[k]);
    if (wanted.uv_da)
        for (int k = 0; k < 2 * n; ++k) (*out.uv_da)[2 * n * pixel + k] = T(uv_bar.by_pixel[k]);
    if (wanted.bias) (*out.bias)[pixel] = T(level_bar);
}

// Adds to `sums`, of all levels of one image's texture: `offset` is where each level begins there.
template <class T, int N>
void texels_vjp(const TextureInput<T>& in, const std::vector<TexelPlane>& planes, int64_t pixel, const T* bar,
                double* sums) {
    const int C = N > 0 ? N : in.shape.channels;
    const PixelLookUp<T> at(in, pixel);
    if (!at.valid()) return;
    const auto add = [&](int64_t texel, double weight) {
        for (int c = 0; c < C; ++c) sums[texel * C + c] += weight * double(bar[c]);
    };
    if (in.look_up == LookUp::nearest) {
        if (const int64_t texel = at.nearest(planes[0]); texel >= 0) add(texel, 1);
        return;
    }
    at.each_level([&](int level, double weight) {
        const Taps taps = at.taps(planes[level]);
        for (int k = 0; k < 4; ++k)
            if (taps.texel[k] >= 0) add(taps.texel[k], weight * taps.weight[k]);
    });
}

// The cotangent of the texels: sums for each image of a texture of its own, put where its levels are among all images'.
template <class T>
Array<T> all_texels_vjp(const TextureInput<T>& in, const T* bar, ThreadTeam& team) {
    TextureShape one = in.shape;
    one.images = 1;
    const int C = in.shape.channels;
    const Targets to{one.all_texels(), C, in.shape.images == 1};
    TextureInput<T> of_one = in;
    of_one.shape = one;
    const std::vector<TexelPlane> planes = planes_of(one, 0);
    Array<T> sums = sums_over<T>(shares_of(in.frames, to), in.frames, to, team, [&](const Share& share, double* found) {
        dispatch_channels(C, false, [&]<int N>() {
            share.each_row([&](int64_t item, int64_t y) {
                const int64_t first = (item * in.frames.height + y) * in.frames.width;
                for (int64_t p = first; p < first + in.frames.width; ++p) {
                    const T* own = bar + p * C;
                    if (std::all_of(own, own + C, [](T x) { return x == 0; })) continue;
                    texels_vjp<T, N>(of_one, planes, p, own, found);
                }
            });
        });
    });
    if (in.shape.images == 1) return sums;
    Array<T> out(in.shape.all_texels() * C);
    team.parallel_for(in.shape.images, [&](int64_t image) {
        for (int level = 0; level < one.levels; ++level)
            std::copy_n(sums.data() + (image * one.all_texels() + one.first(level)) * C, one.texels(level) * C,
                        out.data() + TexelPlane(in.shape, image, level).first * C);
    });
    return out;
}

}  // namespace

template <class T>
Array<T> sample_texture(const TextureInput<T>& in, ThreadTeam& team) {
    const int C = in.shape.channels;
    const Frames& frames = in.frames;
    Array<T> out(frames.pixels() * C);
    constexpr int64_t rows = 8;
    const int64_t bands = (frames.height + rows - 1) / rows;
    team.parallel_for(frames.count * bands, [&](int64_t k) {
        const int64_t image = k / bands, row = k % bands * rows;
        const std::vector<TexelPlane> planes = planes_of(in.shape, image);
        const int64_t first = (image * frames.height + row) * frames.width,
                      end = first + (std::min(row + rows, frames.height) - row) * frames.width;
        dispatch_channels(C, false, [&]<int N>() {
            for (int64_t p = first; p < end; ++p) sample_pixel<N>(in, planes, p, out.data() + p * C);
        });
    });
    return out;
}

template <class T>
TextureGrad<T> sample_texture_vjp(const TextureInput<T>& in, const T* bar, TextureWanted wanted, ThreadTeam& team) {
    const int C = in.shape.channels;
    const Frames& frames = in.frames;
    TextureGrad<T> out;
    if (wanted.texels) out.texels = all_texels_vjp(in, bar, team);
    if (wanted.uv) out.uv.emplace(frames.pixels() * in.coordinates());
    if (wanted.uv_da) out.uv_da.emplace(frames.pixels() * 2 * in.coordinates());
    if (wanted.bias) out.bias.emplace(frames.pixels());
    if (!wanted.coordinates()) return out;
    team.parallel_for(frames.count * frames.height, [&](int64_t row) {
        const std::vector<TexelPlane> planes = planes_of(in.shape, row / frames.height);
        dispatch_channels(C, false, [&]<int N>() {
            for (int64_t p = row * frames.width; p < (row + 1) * frames.width; ++p)
                coordinates_vjp<T, N>(in, planes, p, bar + p * C, wanted, out);
        });
    });
    return out;
}

#define EDGEGRAD_OF(T)                                                     \
    template Array<T> sample_texture(const TextureInput<T>&, ThreadTeam&); \
    template TextureGrad<T> sample_texture_vjp(const TextureInput<T>&, const T*, TextureWanted, ThreadTeam&);
EDGEGRAD_OF(float)
EDGEGRAD_OF(double)

}  // namespace edgegrad
