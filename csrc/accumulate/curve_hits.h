// The points of surfaces that samples on curves show, end to end: what a shader is asked for.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "accumulate/records.h"
#include "core/array.h"
#include "core/parallel.h"

namespace edgegrad {

struct CurveHits {
    explicit CurveHits(int64_t n, int64_t samples)
        : sample(n), face(n), side(n), b(3 * n), x(2 * n), factor(n), to_background(samples) {}

    Array<int64_t> sample;
    Array<int32_t> face, side;    // side: which of the sample's surfaces it is
    Array<double> b, x, factor;   // (N, 3) barycentrics, (N, 2) pixel position
    Array<double> to_background;  // (S,) the factor of what lies behind all surfaces
};

// Barycentrics are no less than `least`, a little inside of a face, so that rounding does not take a step along its
// border for passed: at u = 1 a texture that repeats begins anew. `one`: of the first surface alone.
inline CurveHits curve_hits(const std::vector<CurveRecords>& parts, double least, bool one, ThreadTeam& team) {
    constexpr int all = CurveRecords::surfaces;
    const int most = one ? 1 : all;
    std::vector<int64_t> first_hit{0}, first_sample{0};
    for (const CurveRecords& part : parts) {
        int64_t n = 0;
        for (int64_t i = 0; i < part.size(); ++i)
            n += std::count_if(&part.face[all * i], &part.face[all * i] + most, [](int32_t f) { return f >= 0; });
        first_hit.push_back(first_hit.back() + n), first_sample.push_back(first_sample.back() + part.size());
    }
    CurveHits out(first_hit.back(), first_sample.back());
    team.parallel_for(int64_t(parts.size()), [&](int64_t p) {
        const CurveRecords& part = parts[p];
        int64_t k = first_hit[p];
        for (int64_t i = 0; i < part.size(); ++i) {
            double& background = out.to_background[first_sample[p] + i] = 0;
            for (int side = 0; side < all; ++side) {
                const int64_t at = all * i + side;
                if (part.face[at] == -1) background += part.factor[at];
                if (part.face[at] < 0 || side >= most) continue;
                const double u = part.b[2 * at], v = part.b[2 * at + 1];
                double b[3] = {std::max(1 - (u + v), least), std::max(u, least), std::max(v, least)};
                const double sum = b[0] + b[1] + b[2];
                for (int j = 0; j < 3; ++j) out.b[3 * k + j] = b[j] / sum;
                out.sample[k] = first_sample[p] + i, out.face[k] = part.face[at], out.side[k] = side;
                out.x[2 * k] = part.x[2 * i], out.x[2 * k + 1] = part.x[2 * i + 1], out.factor[k] = part.factor[at];
                ++k;
            }
        }
    });
    return out;
}

}  // namespace edgegrad
