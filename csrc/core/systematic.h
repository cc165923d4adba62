// Systematic sampling: n equally spaced points over a cumulative measure, all moved by one random shift. It serves
// triangles and curves. Each point by itself is distributed as the measure, so sums weighted with M / (n m) are
// unbiased; and because neighbours in the list get neighbouring points, the error falls faster than 1/√n.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/array.h"
#include "core/parallel.h"

namespace edgegrad {

class Systematic {
   public:
    // `measure` holds one number ≥ 0 for each primitive and is turned into its running sum.
    Systematic(Array<double>& measure, ThreadTeam& team) : end_(measure) {
        const int64_t n = end_.size(), blocks = ThreadTeam::blocks(n);
        std::vector<double> before(blocks + 1, 0.0);
        team.parallel_for_blocks(n, [&](int64_t k, int64_t first, int64_t last) {
            double sum = 0;
            for (int64_t i = first; i < last; ++i) {
                // What overflows the range of doubles (coordinates beyond 1e150) cannot be sampled.
                if (!std::isfinite(end_[i])) end_[i] = 0;
                end_[i] = sum += end_[i];
            }
            before[k + 1] = sum;
        });
        for (int64_t k = 0; k < blocks; ++k) before[k + 1] += before[k];
        if (blocks == 1) return;
        team.parallel_for_blocks(n, [&](int64_t k, int64_t first, int64_t last) {
            for (int64_t i = first; i < last; ++i) end_[i] += before[k];
        });
    }

    double total() const { return end_.empty() ? 0 : end_.back(); }

    void draw(int64_t n, double shift) { n_ = n, shift_ = shift; }

    // Position of point i along the measure.
    double position(int64_t i) const { return (double(i) + shift_) * (total() / double(n_)); }

    // The primitive at a position.
    int64_t primitive(double position) const { return find(position, 0, end_.size()); }

    // The same where positions ascend: gallops on from `hint`.
    int64_t primitive(double position, int64_t hint) const {
        const int64_t n = end_.size();
        for (int64_t step = 1, low = hint;; step *= 2) {
            const int64_t high = std::min(low + step, n);
            if (high == n || position < end_[high - 1]) return find(position, low, high);
            low = high;
        }
    }

    // Whether a point may fall on primitive k: true for all that get one, and, by rounding, a few more.
    bool may_draw(int64_t k) const {
        const double per_point = double(n_) / total(), slack = 1e-3;
        const double next = std::ceil(begin_of(k) * per_point - shift_ - slack);
        return measure_of(k) > 0 && next + shift_ <= end_[k] * per_point + slack;
    }

    double begin_of(int64_t k) const { return k ? end_[k - 1] : 0; }
    double measure_of(int64_t k) const { return end_[k] - begin_of(k); }

    // M / (n m): the inverse of the density of points on primitive k, relative to its measure.
    double weight(int64_t k) const { return total() / (double(n_) * measure_of(k)); }

   private:
    int64_t find(double position, int64_t low, int64_t high) const {
        const auto it = std::upper_bound(end_.begin() + low, end_.begin() + high, position);
        if (it != end_.end()) return it - end_.begin();
        // Rounding put the last point on the end: it belongs to the last primitive that has a measure.
        return std::lower_bound(end_.begin(), end_.end(), total()) - end_.begin();
    }

    Array<double>& end_;
    int64_t n_ = 1;
    double shift_ = 0.5;
};

}  // namespace edgegrad
