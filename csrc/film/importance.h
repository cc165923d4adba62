// The importance of a region of the image: the mean size of the adjoint over a rectangle, in constant time.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// A summed-area table (Crow 1984) over integers, so that differences are exact: a rectangle gives zero if and only if
// every adjoint in it is zero, and then leaving it out is no bias. A pixel with an adjoint counts 1 + 8 |A| / mean, the
// one being the defensive lower bound that bounds the weight of what is small but not zero.
class Importance {
   public:
    // Without an adjoint all pixels count the same, and there is no table. What stands for one that is not known yet
    // says nothing of how rough it is.
    template <class T>
    Importance(const T* adjoint, int width, int height, int channels, double radius, ThreadTeam& team,
               bool known = true)
        : width_(width), height_(height), radius_(radius), table_(adjoint ? int64_t(width + 1) * (height + 1) : 0) {
        if (!adjoint) return;
        const auto size = [&](int64_t pixel) {
            double a = 0;
            for (int c = 0; c < channels; ++c) a += std::fabs(double(adjoint[pixel * channels + c]));
            return a;
        };
        // Strips of rows, and of columns, that are worth a thread.
        const int rows = std::max(1, (1 << 14) / width), strips = (height + rows - 1) / rows;
        std::vector<double> row_sum(height, 0.0), row_change(height, 0.0);
        std::vector<int64_t> row_nonzero(height, 0);
        const auto each_row = [&](auto body) {
            team.parallel_for(strips, [&](int64_t k) {
                for (int j = int(k) * rows; j < std::min(height, (int(k) + 1) * rows); ++j) body(j);
            });
        };
        each_row([&](int j) {
            for (int i = 0; i < width; ++i) {
                const double a = size(int64_t(j) * width + i);
                row_sum[j] += a, row_nonzero[j] += a > 0;
            }
            const T* row = adjoint + int64_t(j) * width * channels;
            for (int k = channels; k < width * channels; ++k)
                row_change[j] += std::fabs(double(row[k]) - row[k - channels]);
        });
        const double sum = std::accumulate(row_sum.begin(), row_sum.end(), 0.0);
        const int64_t nonzero = std::accumulate(row_nonzero.begin(), row_nonzero.end(), int64_t(0));
        roughness_ = sum > 0 && known ? std::accumulate(row_change.begin(), row_change.end(), 0.0) / sum : 0;
        per_adjoint_ = sum > 0 ? 8.0 * nonzero / sum : 0;
        const double scale = unit * per_adjoint_;
        each_row([&](int j) {
            int64_t row = table_[index(0, j + 1)] = 0;
            for (int i = 0; i < width; ++i) {
                // The cap keeps the conversion defined; only an adjoint 2²⁰ times the mean meets it.
                const double a = size(int64_t(j) * width + i);
                if (a > 0) row += unit + int64_t(std::min(scale * a, 0x1p32));
                table_[index(i + 1, j + 1)] = row;
            }
        });
        std::fill(table_.begin(), table_.begin() + width + 1, 0);
        const int columns = std::max(64, std::min(width, (1 << 14) / height));
        team.parallel_for((width + columns - 1) / columns, [&](int64_t k) {
            const int first = 1 + int(k) * columns, last = std::min(first + columns, width + 1);
            for (int j = 1; j <= height; ++j)
                for (int i = first; i < last; ++i) table_[index(i, j)] += table_[index(i, j - 1)];
        });
    }

    // Mean over the pixels i0 … i1 − 1, j0 … j1 − 1 of an image; 0 if no adjoint is there.
    double mean(int i0, int i1, int j0, int j1) const {
        if (i0 >= i1 || j0 >= j1) return 0;
        if (table_.empty()) return of(1);
        const int64_t *above = &table_[index(0, j0)], *to = &table_[index(0, j1)];
        return double(to[i1] - to[i0] - above[i1] + above[i0]) / (double(unit) * (double(i1 - i0) * double(j1 - j0)));
    }
    // Asks for what that will read.
    void prefetch(int i0, int i1, int j0, int j1) const {
        if (table_.empty()) return;
        for (const int j : {j0, j1})
            for (const int i : {i0, i1}) edgegrad::prefetch(&table_[index(i, j)]);
    }

    // The same for a place of the image.
    void prefetch(Vec2 x) const {
        const int i = clamp(x.x, width_), j = clamp(x.y, height_);
        prefetch(i, i, j, std::min(j + 1, height_));
    }

    // Mean over the pixels that the filter reaches from a box.
    double mean(Vec2 low, Vec2 high) const {
        return mean(clamp(std::floor(low.x - radius_), width_), clamp(std::floor(high.x + radius_) + 1, width_),
                    clamp(std::floor(low.y - radius_), height_), clamp(std::floor(high.y + radius_) + 1, height_));
    }

    double radius() const { return radius_; }  // of the filter, less ½

    // Mean difference of neighbouring pixels over the mean size: small for a smooth adjoint, √2 for white noise.
    double roughness() const { return roughness_; }

    // Of a pixel whose adjoint has this size.
    double of(double size) const { return size > 0 ? 1 + per_adjoint_ * size : 0; }

   private:
    static constexpr int64_t unit = 1 << 8;
    static int clamp(double x, int most) { return x > 0 ? (x < most ? int(x) : most) : 0; }
    size_t index(int i, int j) const { return size_t(j) * (width_ + 1) + i; }

    int width_, height_;
    double radius_, per_adjoint_ = 8, roughness_ = 0;
    Array<int64_t> table_;
};

}  // namespace edgegrad
