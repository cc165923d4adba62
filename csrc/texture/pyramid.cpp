#include "texture/pyramid.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "core/channels.h"

namespace edgegrad {

namespace {

struct TexelRange {
    int64_t first, end;
    double share;  // weight of one of them
};
// Returns which of `of` texels in a row each of `count` texels over the same length meets. A coarser texel meets the
// finer ones of its mean, and a finer one the coarser ones that contain it.
std::vector<TexelRange> texel_ranges(int64_t count, int64_t of) {
    std::vector<TexelRange> out;
    for (int64_t i = 0; i < count; ++i) {
        const int64_t first = i * of / count, end = ((i + 1) * of + count - 1) / count;
        out.push_back({first, end, 1.0 / double(end - first)});
    }
    return out;
}

// Describes how one level lies on the next finer one.
struct Halving {
    TexelGrid fine, coarse;
    std::vector<TexelRange> down, across;       // for the coarser rows and columns
    std::vector<TexelRange> of_row, of_column;  // for the finer ones

    explicit Halving(const TexelGrid& fine_)
        : fine(fine_),
          coarse(fine_.halved()),
          down(texel_ranges(coarse.height, fine.height)),
          across(texel_ranges(coarse.width, fine.width)),
          of_row(texel_ranges(fine.height, coarse.height)),
          of_column(texel_ranges(fine.width, coarse.width)) {}
    double share(int64_t row, int64_t column) const { return down[row].share * across[column].share; }
};

// Writes row y of the means; the _vjp writes row y of the finer level's cotangent. Pointers refer to first texels. N
// counts the channels, 0: any.
template <int N, class T>
void mean_row(const Halving& at, int channels, int64_t y, const T* fine, T* to) {
    const int C = N ? N : channels;
    for (int64_t x = 0; x < at.coarse.width; ++x, to += C) {
        for (int c = 0; c < C; ++c) to[c] = 0;
        for (int64_t j = at.down[y].first; j < at.down[y].end; ++j)
            for (int64_t i = at.across[x].first; i < at.across[x].end; ++i)
                for (int c = 0; c < C; ++c) to[c] += fine[(j * at.fine.width + i) * C + c];
        const T share = T(at.share(y, x));
        for (int c = 0; c < C; ++c) to[c] *= share;
    }
}
template <int N, class T>
void mean_row_vjp(const Halving& at, int channels, int64_t y, const T* coarse_bar, T* to) {
    const int C = N ? N : channels;
    for (int64_t x = 0; x < at.fine.width; ++x, to += C)
        for (int64_t j = at.of_row[y].first; j < at.of_row[y].end; ++j)
            for (int64_t i = at.of_column[x].first; i < at.of_column[x].end; ++i) {
                const T share = T(at.share(j, i));
                for (int c = 0; c < C; ++c) to[c] += share * coarse_bar[(j * at.coarse.width + i) * C + c];
            }
}

}  // namespace

int PyramidShape::levels() const {
    int n = 1;
    for (TexelGrid at = image; at.height > 1 || at.width > 1; at = at.halved()) ++n;
    return n;
}

int64_t PyramidShape::texels() const {
    TexelGrid at = image;
    for (int left = levels() - 1; left > 0; --left) at = at.halved();
    return at.first + 1;
}

template <class T>
Array<T> pyramid(const PyramidShape& shape, const T* image, ThreadTeam& team) {
    const int C = shape.channels;
    Array<T> out(shape.texels() * C);
    const int64_t row = shape.image.width * C;
    team.parallel_for(shape.image.height, [&](int64_t y) { std::copy_n(image + y * row, row, out.data() + y * row); });
    TexelGrid last = shape.image;
    for (int left = shape.levels() - 1; left > 0; --left) {
        const Halving at(last);
        const T* fine = out.data() + at.fine.first * C;
        T* coarse = out.data() + at.coarse.first * C;
        team.parallel_for(at.coarse.height, [&](int64_t y) {
            dispatch_channels(C, false,
                              [&]<int N>() { mean_row<N>(at, C, y, fine, coarse + y * at.coarse.width * C); });
        });
        last = at.coarse;
    }
    return out;
}

template <class T>
Array<T> pyramid_vjp(const PyramidShape& shape, const T* bar, ThreadTeam& team) {
    const int C = shape.channels;
    std::vector<Halving> all;
    TexelGrid last = shape.image;
    for (int left = shape.levels() - 1; left > 0; --left) all.emplace_back(last), last = all.back().coarse;
    Array<T> found(C);
    std::copy_n(bar + last.first * C, C, found.data());
    for (; !all.empty(); all.pop_back()) {
        const Halving& at = all.back();
        const int64_t row = at.fine.width * C;
        Array<T> own(at.fine.height * row);
        team.parallel_for(at.fine.height, [&](int64_t y) {
            T* to = own.data() + y * row;
            std::copy_n(bar + at.fine.first * C + y * row, row, to);
            dispatch_channels(C, false, [&]<int N>() { mean_row_vjp<N>(at, C, y, found.data(), to); });
        });
        found = std::move(own);
    }
    return found;
}

template Array<float> pyramid(const PyramidShape&, const float*, ThreadTeam&);
template Array<double> pyramid(const PyramidShape&, const double*, ThreadTeam&);
template Array<float> pyramid_vjp(const PyramidShape&, const float*, ThreadTeam&);
template Array<double> pyramid_vjp(const PyramidShape&, const double*, ThreadTeam&);

}  // namespace edgegrad
