// Adds up the gradients of samples, with the same bits at any number of threads. Gradients that come from no sample are
// added elsewhere: backward/backward.cpp has the background, world.h vertices and cameras, raster/sums.h the
// rasteriser.
//
// Samples are processed in chunks of fixed size. A chunk writes rows (index, values) into buffers of its own, one for
// each owner of destinations. Each thread then adds, chunk after chunk, the rows whose destination it owns. Each sum
// therefore has one owner and one order. Chunks come in waves, which bounds the memory; the size of a wave changes no
// order.
#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>
#include <vector>

#include "accumulate/records.h"
#include "camera/camera.h"
#include "core/parallel.h"
#include "core/stopwatch.h"
#include "scene/scene.h"

namespace edgegrad {

class RowBuffer {
   public:
    // Describes the rows of `samples` samples, for an upper bound in bytes with Scatter's owners and chunks. `each`
    // rows of `width` numbers come together for a run of samples on one primitive. There are `primitives`, or as many
    // as samples if that is −1, and `destinations`.
    struct Load {
        int64_t samples, primitives, each, destinations;
        int width;
    };
    static int64_t bytes(const Load& load, int threads);

    void prepare(int width, int owners) {
        if (recent_.empty()) width_ = width, rows_.resize(owners), recent_.resize(n_recent);
    }
    bool is_wanted() const { return !recent_.empty(); }
    void clear() {
        for (Rows& r : rows_) {
            if (r.count < n_recent / 4)
                for (size_t k = 0; k < r.count; ++k) recent_[uint64_t(r.index[k]) % n_recent] = Recent();
            else std::fill(recent_.begin(), recent_.end(), Recent());
            r.count = 0;
        }
    }
    // W is the width at compile time, or 0.
    template <int W = 0>
    void add(int64_t index, const double* values) {
        const int width = W ? W : width_;
        // Neighbours in a mesh follow each other closely and share destinations, so most rows are added to an existing
        // one. The choice does not depend on the owners.
        Recent& recent = recent_[uint64_t(index) % n_recent];
        if (recent.index == index) {
            double* row = rows_[recent.owner].value.data() + size_t(recent.row) * width;
            for (int c = 0; c < width; ++c) row[c] += values[c];
            return;
        }
        const uint32_t owner = rows_.size() > 1 ? uint32_t(uint64_t(index) / run) % uint32_t(rows_.size()) : 0;
        Rows& r = rows_[owner];
        recent = {index, owner, uint32_t(r.count)};
        if (r.count == r.index.size()) {
            r.index.resize(std::max<size_t>(fewest_rows, 2 * r.count));
            r.value.resize(r.index.size() * width);
        }
        r.index[r.count] = index;
        std::copy(values, values + width, r.value.begin() + r.count * width);
        ++r.count;
    }
    // Calls visit(index, values) for each row.
    template <class Visit>
    void each(Visit visit) const {
        for (const Rows& r : rows_)
            for (size_t k = 0; k < r.count; ++k) visit(r.index[k], r.value.data() + k * width_);
    }
    template <class Number>
    void add_to(Number* destination, int owner) const {
        if (width_ == 2) add_rows<2>(destination, rows_[owner]);
        else if (width_ == 3) add_rows<3>(destination, rows_[owner]);
        else add_rows<0>(destination, rows_[owner]);
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
    template <int W, class Number>
    void add_rows(Number* destination, const Rows& r) const {
        const int width = W ? W : width_;
        for (size_t k = 0; k < r.count; ++k)
            for (int c = 0; c < width; ++c) destination[r.index[k] * width + c] += Number(r.value[k * width + c]);
    }
    static constexpr int n_recent = 256;
    static constexpr size_t fewest_rows = 16;  // A buffer has room for this many once it is used.
    // Owners take runs of destinations in turn, which balances work and keeps owners apart in cache lines.
    static constexpr uint64_t run = 32;
    int width_ = 0;
    std::vector<Rows> rows_;  // Each owner has one.
    std::vector<Recent> recent_;
};

// Holds how a shadow boundary moves with the light's point that casts it, for the record of one sample.
struct LightMotion {
    int32_t part = -1;
    Vec2 uv;
    Vec3 by_place;  // It is in camera coordinates.
};

// Holds the thread-local gradients of one chunk of samples.
struct LocalGradients {
    RowBuffer q, x, colors, uvs, texels, alphas;  // Vertices have q in camera coordinates and x in the image.
    RowBuffer vertex_attributes, face_attributes;
    RowBuffer pixels;  // They belong to an array of the image's size.
    IntrinsicsGrad k;
    LightMotion light;
    Records records;
};

// Points to the gradients' destinations; null where none is wanted.
struct GradientSink {
    double *q = nullptr, *x = nullptr, *colors = nullptr, *uvs = nullptr, *texels = nullptr, *alphas = nullptr;
    double *vertex_attributes = nullptr, *face_attributes = nullptr, *pixels = nullptr;
    int pixel_width = 0;  // It counts numbers per pixel.
    IntrinsicsGrad k = {};
    bool want_k = false;
    RecordList* records = nullptr;
};

struct RowSlot;  // It pairs the rows of both with their width.

// Limits samples per chunk, chunks in memory per thread, and owners. More owners would only split the buffers further.
constexpr int64_t scatter_chunk = 512, chunks_in_flight = 16;
constexpr int most_owners = 16;

// Calls body(first, last, chunk) for all samples 0 … n − 1, after prepare(chunk, owners). Then calls add(chunk, owner)
// for the chunks in order and each owner, and last(chunk). `seconds` gets the times of sampling and of adding.
template <class Chunk, class Prepare, class Body, class Add, class Last>
void scatter_in_waves(ThreadTeam& team, int64_t n, std::vector<Chunk>& chunks, Prepare prepare, Body body, Add add,
                      Last last, double (&seconds)[2]) {
    const int64_t size = scatter_chunk, wave = chunks_in_flight * team.threads();
    const int owners = std::min(team.threads(), most_owners);
    if (const int64_t most = std::min(wave, (n + size - 1) / size); int64_t(chunks.size()) < most) chunks.resize(most);
    Stopwatch watch;
    for (int64_t first = 0; first < n; first += size * wave) {
        team.check();  // The calling thread may get no chunk of a wave.
        const int64_t count = std::min(wave, (n - first + size - 1) / size);
        team.parallel_for(count, [&](int64_t i) {
            prepare(chunks[i], owners);
            const int64_t begin = first + i * size;
            body(begin, std::min(begin + size, n), chunks[i]);
        });
        seconds[0] += watch.lap();
        team.parallel_for(owners, [&](int64_t owner) {
            for (int64_t i = 0; i < count; ++i) add(chunks[i], int(owner));
        });
        for (int64_t i = 0; i < count; ++i) last(chunks[i]);
        seconds[1] += watch.lap();
    }
}

// Holds the buffers of one backward pass, which its parts use one after the other.
class Scatter {
   public:
    struct Widths {
        int radiance, vertex_attributes, face_attributes;
    };
    Scatter(ThreadTeam& team, Widths widths) : team_(team), widths_(widths) {}

    // Calls body(first, last, grad) for all samples 0 … n − 1, and adds what it wrote to `to`. `seconds` gets the times
    // of sampling and of adding.
    using Body = std::function<void(int64_t first, int64_t last, LocalGradients& grad)>;
    void add(int64_t n, GradientSink& to, double (&seconds)[2], const Body& body);

   private:
    void prepare(LocalGradients& g, const GradientSink& to, int owners) const;
    int width_of(const RowSlot& slot, const GradientSink& to) const;

    ThreadTeam& team_;
    const Widths widths_;
    std::vector<LocalGradients> grads_;
};

}  // namespace edgegrad
