// The only writer of gradients: the same bits at any number of threads.
//
// Samples are worked on in chunks of fixed size. A chunk writes rows (index, values) into buffers of its own; then each
// thread walks over all rows in order and adds those whose destination it owns. So each sum has one owner and one
// order. Chunks are taken in waves, which bounds the memory.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "scene.h"

namespace edgegrad {

inline int thread_index() {
#ifdef _OPENMP
    return omp_get_thread_num();
#else
    return 0;
#endif
}

class RowBuffer {
   public:
    void set_width(int width) { width_ = width; }
    void clear() { index_.clear(), value_.clear(); }
    void add(int64_t index, const double* values) {
        index_.push_back(index);
        value_.insert(value_.end(), values, values + width_);
    }

    // Adds the rows that this one of `owners` owns: runs of 32 rows in turn, which balances and keeps to cache lines.
    void add_to(double* destination, int owner, int owners) const {
        for (size_t r = 0; r < index_.size(); ++r) {
            const int64_t i = index_[r];
            if (owners > 1 && (i >> 5) % owners != owner) continue;
            for (int c = 0; c < width_; ++c) destination[i * width_ + c] += value_[r * width_ + c];
        }
    }

   private:
    int width_ = 0;
    std::vector<int64_t> index_;
    std::vector<double> value_;
};

// What the samples of one chunk give.
struct ChunkGrad {
    RowBuffer q, colors, uvs, texels;  // q: vertices in camera coordinates
    double k[6] = {};                  // the upper rows of K
};

// Where it goes; null where none is wanted.
struct Destination {
    double *q = nullptr, *colors = nullptr, *uvs = nullptr, *texels = nullptr;
    double k[6] = {};
    int channels = 1;
};

// Calls body(first, last, ChunkGrad&) for all samples 0 … n − 1, and adds what it wrote to `to`.
template <class Body>
void scatter_samples(int64_t n, int threads, Destination& to, Body body) {
    const int64_t chunk = 512, wave = 256;
    std::vector<ChunkGrad> grads(std::min(wave, (n + chunk - 1) / chunk));
    for (ChunkGrad& g : grads) {
        g.q.set_width(3), g.uvs.set_width(2);
        g.colors.set_width(to.channels), g.texels.set_width(to.channels);
    }
    for (int64_t first = 0; first < n; first += chunk * wave) {
        const int64_t chunks = std::min(wave, (n - first + chunk - 1) / chunk);
#pragma omp parallel num_threads(threads)
        {
#pragma omp for schedule(dynamic, 1)
            for (int64_t i = 0; i < chunks; ++i) {
                ChunkGrad& g = grads[i];
                g.q.clear(), g.colors.clear(), g.uvs.clear(), g.texels.clear();
                std::fill(g.k, g.k + 6, 0.0);
                const int64_t begin = first + i * chunk;
                body(begin, std::min(begin + chunk, n), g);
            }
            const int owner = thread_index();
#ifdef _OPENMP
            const int owners = omp_get_num_threads();
#else
            const int owners = 1;
#endif
            for (int64_t i = 0; i < chunks; ++i) {
                if (to.q) grads[i].q.add_to(to.q, owner, owners);
                if (to.colors) grads[i].colors.add_to(to.colors, owner, owners);
                if (to.uvs) grads[i].uvs.add_to(to.uvs, owner, owners);
                if (to.texels) grads[i].texels.add_to(to.texels, owner, owners);
            }
        }
        for (int64_t i = 0; i < chunks; ++i)
            for (int c = 0; c < 6; ++c) to.k[c] += grads[i].k[c];
    }
}

}  // namespace edgegrad
