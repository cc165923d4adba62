// The only writer of gradients: the same bits at any number of threads.
//
// Samples are worked on in chunks of fixed size. A chunk writes rows (index, values) into buffers of its own, one for
// each owner of destinations; then each thread adds, chunk after chunk, the rows whose destination it owns. So each sum
// has one owner and one order. Chunks are taken in waves, which bounds the memory; how many a wave has changes no
// order.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "parallel.h"
#include "scene.h"
#include "stopwatch.h"

namespace edgegrad {

class RowBuffer {
   public:
    void prepare(int width, int owners) { width_ = width, rows_.resize(owners); }
    void clear() {
        for (Rows& r : rows_) r.count = 0;
        for (Recent& r : recent_) r.index = -1;
    }
    // W: the width at compile time, or 0.
    template <int W = 0>
    void add(int64_t index, const double* values) {
        const int width = W ? W : width_;
        // Neighbours in a mesh come soon after one another and share destinations: most rows are added to one that is
        // there. Which are does not depend on the owners.
        Recent& recent = recent_[uint64_t(index) % n_recent];
        if (recent.index == index) {
            double* row = rows_[recent.owner].value.data() + size_t(recent.row) * width;
            for (int c = 0; c < width; ++c) row[c] += values[c];
            return;
        }
        // Runs of 32 destinations in turn, which balances and keeps owners apart in cache lines.
        const uint32_t owner = rows_.size() > 1 ? uint32_t(index >> 5) % uint32_t(rows_.size()) : 0;
        Rows& r = rows_[owner];
        recent = {index, owner, uint32_t(r.count)};
        if (r.count == r.index.size()) {
            r.index.resize(std::max<size_t>(16, 2 * r.count));
            r.value.resize(r.index.size() * width);
        }
        r.index[r.count] = index;
        std::copy(values, values + width, r.value.begin() + r.count * width);
        ++r.count;
    }
    void add_to(double* destination, int owner) const {
        if (width_ == 2) add_to<2>(destination, rows_[owner]);
        else if (width_ == 3) add_to<3>(destination, rows_[owner]);
        else add_to<0>(destination, rows_[owner]);
    }

   private:
    struct Rows {
        size_t count = 0;
        std::vector<int64_t> index;
        std::vector<double> value;
    };
    struct Recent {
        int64_t index = -1;
        uint32_t owner = 0, row = 0;
    };
    template <int W>
    void add_to(double* destination, const Rows& r) const {
        const int width = W ? W : width_;
        for (size_t k = 0; k < r.count; ++k)
            for (int c = 0; c < width; ++c) destination[r.index[k] * width + c] += r.value[k * width + c];
    }
    static constexpr int n_recent = 256;
    int width_ = 0;
    std::vector<Rows> rows_;  // one for each owner
    Recent recent_[n_recent];
};

// What the samples of one chunk give.
struct ChunkGrad {
    RowBuffer q, x, colors, uvs, texels;  // vertices: q in camera coordinates, x in the image
    double k[6] = {};                     // the upper rows of K
};

// Where it goes; null where none is wanted.
struct Destination {
    double *q = nullptr, *x = nullptr, *colors = nullptr, *uvs = nullptr, *texels = nullptr;
    double k[6] = {};
    bool want_k = false;
    int channels = 1;
};

// Samples in a chunk.
constexpr int64_t scatter_chunk = 512;

// Calls body(first, last, ChunkGrad&) for all samples 0 … n − 1, and adds what it wrote to `to`. `seconds`: of the
// samples and of the adding.
template <class Body>
void scatter_samples(int64_t n, Team& team, Destination& to, double (&seconds)[2], Body body) {
    const int64_t chunk = scatter_chunk, wave = 16 * team.threads();
    const int owners = std::min(team.threads(), 16);  // more would only split the buffers further
    std::vector<ChunkGrad> grads(std::min(wave, (n + chunk - 1) / chunk));
    for (ChunkGrad& g : grads) {
        g.q.prepare(3, owners), g.x.prepare(2, owners), g.uvs.prepare(2, owners);
        g.colors.prepare(to.channels, owners), g.texels.prepare(to.channels, owners);
    }
    Stopwatch watch;
    for (int64_t first = 0; first < n; first += chunk * wave) {
        const int64_t chunks = std::min(wave, (n - first + chunk - 1) / chunk);
        // One region for both loops: waking threads twice a wave would be felt.
#pragma omp parallel num_threads(team.threads_for(chunks))
        {
#pragma omp for schedule(dynamic, 1)
            for (int64_t i = 0; i < chunks; ++i)
                team.guard([&] {
                    team.check();
                    ChunkGrad& g = grads[i];
                    g.q.clear(), g.x.clear(), g.colors.clear(), g.uvs.clear(), g.texels.clear();
                    std::fill(g.k, g.k + 6, 0.0);
                    const int64_t begin = first + i * chunk;
                    body(begin, std::min(begin + chunk, n), g);
                });
#pragma omp master
            seconds[0] += watch.lap();
            // The system may give fewer threads than were asked for.
#pragma omp for schedule(static, 1)
            for (int owner = 0; owner < owners; ++owner)
                team.guard([&] {
                    for (int64_t i = 0; i < chunks; ++i) {
                        if (to.q) grads[i].q.add_to(to.q, owner);
                        if (to.x) grads[i].x.add_to(to.x, owner);
                        if (to.colors) grads[i].colors.add_to(to.colors, owner);
                        if (to.uvs) grads[i].uvs.add_to(to.uvs, owner);
                        if (to.texels) grads[i].texels.add_to(to.texels, owner);
                    }
                });
        }
        team.rethrow();
        for (int64_t i = 0; i < chunks; ++i)
            for (int c = 0; c < 6; ++c) to.k[c] += grads[i].k[c];
        seconds[1] += watch.lap();
    }
}

}  // namespace edgegrad
