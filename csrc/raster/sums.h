// Sums over the pixels of a batch into rows that pixels share, with the same bits at any number of threads. Images are
// split into shares, whose number depends on sizes alone. Each share has one thread and its own buffers, and these are
// added in order.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "raster/triangles.h"

namespace edgegrad {

// Selects rows of some images.
struct Share {
    int64_t item, end_item;  // images; several images have all their rows
    int64_t row, end_row;
    int64_t first_target, targets;  // rows of numbers to which they may add

    // Calls visit(item, row) for each row.
    template <class Visit>
    void each_row(Visit visit) const {
        for (int64_t b = item; b < end_item; ++b)
            for (int64_t y = row; y < end_row; ++y) visit(b, y);
    }
};

// Describes the rows of numbers: `count` for each image, or for all of them together.
struct Targets {
    int64_t count;
    int width;
    bool shared;
};

inline std::vector<Share> shares_of(const Frames& frames, const Targets& to) {
    constexpr int64_t most = 8;  // Beyond this, threads gain less than the buffers cost.
    std::vector<Share> out;
    if (to.shared) {
        // Buffers are at most as many as there is work to fill them.
        const int64_t n =
            std::clamp<int64_t>(4 * frames.pixels() / std::max<int64_t>(1, to.count), 1, std::min(most, frames.count));
        for (int64_t k = 0; k < n; ++k)
            out.push_back({k * frames.count / n, (k + 1) * frames.count / n, 0, frames.height, 0, to.count});
        if (frames.count > 1 || to.count > frames.pixels()) return out;
        out.clear();
    }
    const int64_t bands = std::clamp<int64_t>(4 / std::max<int64_t>(1, frames.count), 1, frames.height);
    for (int64_t b = 0; b < frames.count; ++b)
        for (int64_t k = 0; k < bands; ++k)
            out.push_back({b, b + 1, k * frames.height / bands, (k + 1) * frames.height / bands, 0, to.count});
    return out;
}

// Calls body(share, sums) for each share, where sums are (targets, width) doubles, zero at first. Returns the total as
// T: (count, width), or (images, count, width) where it is not shared.
template <class T, class Body>
Array<T> sums_over(const std::vector<Share>& shares, const Frames& frames, const Targets& to, ThreadTeam& team,
                   Body body) {
    std::vector<Array<double>> found;
    for (size_t k = 0; k < shares.size(); ++k) found.emplace_back(0);
    team.parallel_for(int64_t(shares.size()), [&](int64_t k) {
        found[k] = Array<double>(shares[k].targets * to.width);
        std::fill(found[k].begin(), found[k].end(), 0.0);
        body(shares[k], found[k].data());
    });
    const int64_t images = to.shared ? 1 : frames.count, stride = to.count * to.width;
    Array<T> out(images * stride);
    // One thread adds each block of rows in the order of the shares.
    constexpr int64_t block = 1 << 14;
    const int64_t blocks = std::max<int64_t>(1, (stride + block - 1) / block);
    team.parallel_for(images * blocks, [&](int64_t k) {
        const int64_t image = k / blocks, first = k % blocks * block, end = std::min(stride, first + block);
        double sum[block];
        std::fill(sum, sum + (end - first), 0.0);
        for (size_t s = 0; s < shares.size(); ++s) {
            if (!to.shared && shares[s].item != image) continue;
            const int64_t from = shares[s].first_target * to.width, until = from + shares[s].targets * to.width;
            for (int64_t i = std::max(first, from); i < std::min(end, until); ++i) sum[i - first] += found[s][i - from];
        }
        for (int64_t i = first; i < end; ++i) out[image * stride + i] = T(sum[i - first]);
    });
    return out;
}

// Returns shares whose targets are vertices. An image with a range of triangles only has those between the first and
// the last that it uses.
template <class T>
std::vector<Share> shares_of_vertices(const Frames& frames, const Triangles<T>& mesh, const Targets& to) {
    if (!mesh.ranges) return shares_of(frames, to);
    std::vector<Share> out = shares_of(frames, {to.count, to.width, false});
    for (Share& share : out) {
        const int32_t* from = mesh.tri + 3 * mesh.first(share.item);
        const int32_t* until = mesh.tri + 3 * mesh.end(share.item);
        const auto [low, high] = std::minmax_element(from, until);
        share.first_target = from == until ? 0 : *low, share.targets = from == until ? 0 : *high + 1 - *low;
    }
    return out;
}

}  // namespace edgegrad
