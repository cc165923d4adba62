#include "raster/sample_texture.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/channels.h"
#include "raster/sums.h"
#include "raster/texture_level.h"
#include "texture/pyramid_level.h"

namespace edgegrad {

namespace {

template <class T>
class PixelLookUp {
   public:
    PixelLookUp(const TextureInput<T>& in, int64_t pixel) : in_(in) {
        const int n = in.coordinates();
        for (int k = 0; k < n; ++k) uv_.at[k] = double(in.uv[n * pixel + k]);
        valid_ = place_of(uv_, in.shape.boundary_mode, place_);
        if (!valid_ || in.look_up == LookUp::nearest || in.look_up == LookUp::linear) return;
        double level = 0;
        if (in.uv_da) {
            for (int k = 0; k < 2 * n; ++k) uv_.by_pixel[k] = double(in.uv_da[2 * n * pixel + k]);
            level = LongAxis(texels_a_pixel(uv_, in.shape, place_)).level;
        }
        if (in.bias) level += double(in.bias[pixel]);
        level_ = {level, in.shape.levels};
        if (in.look_up == LookUp::linear_nearest_level)
            level_ = {std::floor(level_.fine + level_.share + 0.5), in.shape.levels}, level_.is_between = false;
    }
    bool valid() const { return valid_; }

    int64_t nearest(const TexelGrid& grid) const { return nearest_texel(grid, place_, in_.shape.boundary_mode); }
    BorderedFootprint linear(const TexelGrid& grid) const { return footprint(grid, place_, in_.shape.boundary_mode); }

    // Adds the cotangents, given those of s and t and of the level.
    void vjp(Vec2 place_bar, double level_bar, TextureCoordinates& uv_bar) const {
        place_vjp(uv_, in_.shape.boundary_mode, place_, place_bar, uv_bar);
        if (!level_.is_between || !in_.uv_da || level_bar == 0) return;
        const Mat2 jacobian = texels_a_pixel(uv_, in_.shape, place_);
        const Mat2 bar = long_axis_vjp(jacobian, LongAxis(jacobian), level_bar);
        texels_a_pixel_vjp(uv_, in_.shape, place_, bar, uv_bar);
    }
    const PyramidLevel<double>& level() const { return level_; }

   private:
    const TextureInput<T>& in_;
    TextureCoordinates uv_;
    TexturePlace place_;
    bool valid_;
    PyramidLevel<double> level_;
};

// Returns the levels of one image's texture.
std::vector<TexelGrid> grids_of(const TextureShape& shape, int64_t image) {
    std::vector<TexelGrid> out;
    for (int level = 0; level < shape.levels; ++level) out.push_back(shape.grid(image, level));
    return out;
}

template <int N, class T>
void sample_pixel(const TextureInput<T>& in, const std::vector<TexelGrid>& grids, int64_t pixel, T* to) {
    const int C = N > 0 ? N : in.shape.channels;
    const PixelLookUp<T> at(in, pixel);
    if (!at.valid()) {
        std::fill_n(to, C, T(0));
        return;
    }
    if (in.look_up == LookUp::nearest) {
        const int64_t texel = at.nearest(grids[0]);
        for (int c = 0; c < C; ++c) to[c] = texel < 0 ? T(0) : in.texels[texel * C + c];
        return;
    }
    double fixed[N > 0 ? N : 1] = {};
    std::vector<double> many(N > 0 ? 0 : C, 0.0);
    double* sum = N > 0 ? fixed : many.data();
    at.level().each([&](int level, double weight) {
        const BorderedFootprint f = at.linear(grids[level]);
        for (int k = 0; k < 4; ++k) {
            if (f.texel[k] < 0) continue;
            const T* texel = in.texels + f.texel[k] * C;
            const double w = weight * f.weight(k);
            for (int c = 0; c < C; ++c) sum[c] += w * double(texel[c]);
        }
    });
    for (int c = 0; c < C; ++c) to[c] = T(sum[c]);
}

template <class T, int N>
void coordinates_vjp(const TextureInput<T>& in, const std::vector<TexelGrid>& grids, int64_t pixel, const T* bar,
                     TextureWanted wanted, TextureGrad<T>& out) {
    const int C = N > 0 ? N : in.shape.channels, n = in.coordinates();
    TextureCoordinates uv_bar;
    double level_bar = 0;
    const PixelLookUp<T> at(in, pixel);
    if (at.valid() && in.look_up != LookUp::nearest) {
        Vec2 place_bar;
        double value[2] = {};  // bar · what each level shows
        int index = 0;
        at.level().each([&](int level, double weight) {
            const TexelGrid& grid = grids[level];
            const BorderedFootprint f = at.linear(grid);
            double s[4] = {};  // bar · texel
            for (int k = 0; k < 4; ++k) {
                if (f.texel[k] < 0) continue;
                const T* texel = in.texels + f.texel[k] * C;
                for (int c = 0; c < C; ++c) s[k] += double(bar[c]) * double(texel[c]);
            }
            f.fill_corner(s);
            const Vec2 slopes = f.slopes(s);
            place_bar += Vec2{weight * f.moves.x * slopes.x * double(grid.width),
                              weight * f.moves.y * slopes.y * double(grid.height)};
            value[index++] = f.interpolate(s);
        });
        if (at.level().is_between) level_bar = value[1] - value[0];
        at.vjp(place_bar, level_bar, uv_bar);
    }
    if (wanted.uv)
        for (int k = 0; k < n; ++k) (*out.uv)[n * pixel + k] = T(uv_bar.at[k]);
    if (wanted.uv_da)
        for (int k = 0; k < 2 * n; ++k) (*out.uv_da)[2 * n * pixel + k] = T(uv_bar.by_pixel[k]);
    if (wanted.bias) (*out.bias)[pixel] = T(level_bar);
}

// Adds to `sums`, which covers all levels of one image's texture.
template <class T, int N>
void texels_vjp(const TextureInput<T>& in, const std::vector<TexelGrid>& grids, int64_t pixel, const T* bar,
                double* sums) {
    const int C = N > 0 ? N : in.shape.channels;
    const PixelLookUp<T> at(in, pixel);
    if (!at.valid()) return;
    const auto add = [&](int64_t texel, double weight) {
        for (int c = 0; c < C; ++c) sums[texel * C + c] += weight * double(bar[c]);
    };
    if (in.look_up == LookUp::nearest) {
        if (const int64_t texel = at.nearest(grids[0]); texel >= 0) add(texel, 1);
        return;
    }
    at.level().each([&](int level, double weight) {
        const BorderedFootprint f = at.linear(grids[level]);
        for (int k = 0; k < 4; ++k)
            if (f.texel[k] >= 0) add(f.texel[k], weight * f.weight(k));
    });
}

// Returns the cotangent of the texels. It sums per image, then moves the levels to their places among all images'.
template <class T>
Array<T> all_texels_vjp(const TextureInput<T>& in, const T* bar, ThreadTeam& team) {
    TextureShape one = in.shape;
    one.images = 1;
    const int C = in.shape.channels;
    const Targets to{one.all_texels(), C, in.shape.images == 1};
    TextureInput<T> of_one = in;
    of_one.shape = one;
    const std::vector<TexelGrid> grids = grids_of(one, 0);
    Array<T> sums = sums_over<T>(shares_of(in.frames, to), in.frames, to, team, [&](const Share& share, double* found) {
        dispatch_channels(C, false, [&]<int N>() {
            share.each_row([&](int64_t item, int64_t y) {
                const int64_t first = (item * in.frames.height + y) * in.frames.width;
                for (int64_t p = first; p < first + in.frames.width; ++p) {
                    const T* own = bar + p * C;
                    if (std::all_of(own, own + C, [](T x) { return x == 0; })) continue;
                    texels_vjp<T, N>(of_one, grids, p, own, found);
                }
            });
        });
    });
    if (in.shape.images == 1) return sums;
    Array<T> out(in.shape.all_texels() * C);
    team.parallel_for(in.shape.images, [&](int64_t image) {
        for (int level = 0; level < one.levels; ++level)
            std::copy_n(sums.data() + (image * one.all_texels() + one.first(level)) * C, one.texels(level) * C,
                        out.data() + in.shape.grid(image, level).first * C);
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
        const std::vector<TexelGrid> grids = grids_of(in.shape, image);
        const int64_t first = (image * frames.height + row) * frames.width,
                      end = first + (std::min(row + rows, frames.height) - row) * frames.width;
        dispatch_channels(C, false, [&]<int N>() {
            for (int64_t p = first; p < end; ++p) sample_pixel<N>(in, grids, p, out.data() + p * C);
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
        const std::vector<TexelGrid> grids = grids_of(in.shape, row / frames.height);
        dispatch_channels(C, false, [&]<int N>() {
            for (int64_t p = row * frames.width; p < (row + 1) * frames.width; ++p)
                coordinates_vjp<T, N>(in, grids, p, bar + p * C, wanted, out);
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
