#include "shading/pyramid.h"

#include <algorithm>
#include <utility>
#include <vector>

namespace edgegrad {

namespace {

struct Window {
    int64_t first, end;
    int64_t size() const { return end - first; }
};
// Which of `of` texels in a row each of `count` meets that span the same: of the finer ones those that it is a mean of,
// and of the coarser ones those that it goes into.
std::vector<Window> windows(int64_t count, int64_t of) {
    std::vector<Window> out;
    for (int64_t i = 0; i < count; ++i) out.push_back({i * of / count, ((i + 1) * of + count - 1) / count});
    return out;
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
Array<T> pyramid(const PyramidShape& shape, const T* image, Team& team) {
    const int C = shape.channels;
    Array<T> out(shape.texels() * C);
    team.each(shape.image.height, [&](int64_t row) {
        const int64_t n = shape.image.width * C;
        std::copy(image + row * n, image + (row + 1) * n, out.data() + row * n);
    });
    TexelGrid fine = shape.image;
    for (int left = shape.levels() - 1; left > 0; --left) {
        const TexelGrid coarse = fine.halved();
        const std::vector<Window> down = windows(coarse.height, fine.height),
                                  across = windows(coarse.width, fine.width);
        team.each(coarse.height, [&](int64_t y) {
            const Window rows = down[y];
            T* to = out.data() + (coarse.first + y * coarse.width) * C;
            for (int64_t x = 0; x < coarse.width; ++x, to += C) {
                const Window columns = across[x];
                for (int c = 0; c < C; ++c) to[c] = 0;
                for (int64_t j = rows.first; j < rows.end; ++j) {
                    const T* from = out.data() + (fine.first + j * fine.width + columns.first) * C;
                    for (int64_t i = 0; i < columns.size(); ++i, from += C)
                        for (int c = 0; c < C; ++c) to[c] += from[c];
                }
                const T share = T(1) / T(rows.size() * columns.size());
                for (int c = 0; c < C; ++c) to[c] *= share;
            }
        });
        fine = coarse;
    }
    return out;
}

template <class T>
Array<T> pyramid_vjp(const PyramidShape& shape, const T* bar, Team& team) {
    const int C = shape.channels;
    std::vector<TexelGrid> grids{shape.image};
    for (int left = shape.levels() - 1; left > 0; --left) grids.push_back(grids.back().halved());
    Array<T> above(0);  // of the level above
    for (size_t level = grids.size(); level-- > 0;) {
        const TexelGrid fine = grids[level];
        Array<T> own(fine.height * fine.width * C);
        const T* given = bar + fine.first * C;
        const TexelGrid coarse = level + 1 < grids.size() ? grids[level + 1] : TexelGrid{0, 0, 0};
        const std::vector<Window> down = windows(coarse.height, fine.height),
                                  across = windows(coarse.width, fine.width), up = windows(fine.height, coarse.height),
                                  along = windows(fine.width, coarse.width);
        team.each(fine.height, [&](int64_t y) {
            T* to = own.data() + y * fine.width * C;
            const T* from = given + y * fine.width * C;
            std::copy(from, from + fine.width * C, to);
            if (coarse.height == 0) return;
            for (int64_t x = 0; x < fine.width; ++x, to += C)
                for (int64_t j = up[y].first; j < up[y].end; ++j)
                    for (int64_t i = along[x].first; i < along[x].end; ++i) {
                        const T share = T(1) / T(down[j].size() * across[i].size());
                        const T* mean = above.data() + (j * coarse.width + i) * C;
                        for (int c = 0; c < C; ++c) to[c] += mean[c] * share;
                    }
        });
        above = std::move(own);
    }
    return above;
}

template Array<float> pyramid(const PyramidShape&, const float*, Team&);
template Array<double> pyramid(const PyramidShape&, const double*, Team&);
template Array<float> pyramid_vjp(const PyramidShape&, const float*, Team&);
template Array<double> pyramid_vjp(const PyramidShape&, const double*, Team&);

}  // namespace edgegrad
