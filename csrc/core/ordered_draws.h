// The samples of a systematic draw in an order in which neighbours are near one another in the image, so that their
// rays pass the same boxes and what is asked of their primitives is in the cache. Meshes come in any order: that of a
// subdivision visits distant faces by turns.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <utility>
#include <vector>

#include "core/parallel.h"
#include "core/systematic.h"

namespace edgegrad {

class OrderedDraws {
   public:
    // n samples, kind after kind: `ends` says up to which primitive each kind goes. Within a kind they are in the order
    // of key(k) of their primitive k, a number of 16 bits, and those of one primitive side by side.
    template <class Key>
    OrderedDraws(const Systematic& systematic, int64_t n, const std::vector<int64_t>& ends, Key key, ThreadTeam& team)
        : systematic_(systematic) {
        std::vector<std::vector<Run>> parts((n + part - 1) / part);
        team.parallel_for(int64_t(parts.size()), [&](int64_t p) {
            std::vector<Run> runs;
            int64_t k = systematic.primitive(systematic.position(p * part));
            for (int64_t i = p * part; i < std::min(n, (p + 1) * part); ++i) {
                k = systematic.primitive(systematic.position(i), k);
                if (runs.empty() || runs.back().primitive != k)
                    runs.push_back({.primitive = k, .sample = i, .count = 0, .place = 0, .key = uint16_t(key(k))});
                ++runs.back().count;
            }
            parts[p] = std::move(runs);
        });
        for (const std::vector<Run>& runs : parts) runs_.insert(runs_.end(), runs.begin(), runs.end());
        int64_t place = 0;
        size_t first = 0;
        for (const int64_t end : ends) {
            const size_t last = std::partition_point(runs_.begin() + first, runs_.end(),
                                                     [&](const Run& run) { return run.primitive < end; }) -
                                runs_.begin();
            sort(first, last);
            for (; first < last; ++first) runs_[first].place = place, place += runs_[first].count;
            ends_.push_back(place);
        }
    }

    // In this order the samples of a kind end at this place.
    int64_t end_of_kind(int kind) const { return ends_[kind]; }

    // Calls body(k, i) for the samples at the places first … last − 1: i, on the primitive k.
    template <class Body>
    void each(int64_t first, int64_t last, Body body) const {
        auto run = std::partition_point(runs_.begin(), runs_.end(), [&](const Run& r) { return r.place <= first; }) - 1;
        for (int64_t at = first; at < last; ++run)
            for (; at < std::min(last, run->place + run->count); ++at)
                body(run->primitive, run->sample + (at - run->place));
    }

    const Systematic& systematic() const { return systematic_; }

    // At most, of so many samples on so many primitives.
    static int64_t bytes(int64_t samples, int64_t primitives) {
        const int64_t runs = std::min(samples, primitives + samples / part + 1);
        return 3 * runs * int64_t(sizeof(Run));
    }

   private:
    // Samples sample … sample + count − 1 are on one primitive; in the order they begin at `place`.
    struct Run {
        int64_t primitive, sample, count, place;
        uint16_t key;
    };
    static constexpr int64_t part = 1 << 10;  // samples of a thread's; a run ends with it

    // By the lower and then by the upper byte of the key.
    void sort(size_t first, size_t last) {
        std::vector<Run> sorted(last - first);
        for (const int shift : {0, 8}) {
            const auto digit = [&](const Run& run) { return run.key >> shift & 255; };
            std::array<size_t, 257> at{};
            for (size_t r = first; r < last; ++r) ++at[digit(runs_[r]) + 1];
            for (int d = 0; d < 256; ++d) at[d + 1] += at[d];
            for (size_t r = first; r < last; ++r) sorted[at[digit(runs_[r])]++] = runs_[r];
            std::copy(sorted.begin(), sorted.end(), runs_.begin() + first);
        }
    }

    const Systematic& systematic_;
    std::vector<Run> runs_;
    std::vector<int64_t> ends_;
};

}  // namespace edgegrad
