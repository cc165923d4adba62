#include "raster/interpolate.h"

#include <algorithm>

#include "core/channels.h"
#include "raster/sums.h"

namespace edgegrad {

namespace {

// What of one triangle is interpolated: a = u a₀ + v a₁ + (1 − u − v) a₂.
template <class T>
struct Corners {
    const T* row[3];
    int32_t vertex[3];

    Corners(const VertexAttributes<T>& attr, const RasterView<T>& at, int64_t item, int64_t triangle) {
        for (int i = 0; i < 3; ++i) vertex[i] = at.tri[3 * triangle + i], row[i] = attr.row(item, vertex[i]);
    }
    double by_u(int c) const { return double(row[0][c]) - double(row[2][c]); }
    double by_v(int c) const { return double(row[1][c]) - double(row[2][c]); }
};

template <int N, class T>
void interpolate_row(const VertexAttributes<T>& attr, const RasterView<T>& at, const std::vector<int>& chosen,
                     int64_t item, int64_t first, Interpolated<T>& out) {
    const int A = N > 0 ? N : attr.width, D = int(chosen.size());
    for (int64_t p = first; p < first + at.frames.width; ++p) {
        T *to = out.values.data() + p * A, *da = out.da.data() + p * 2 * D;
        const RasterPixel<T> seen(at.rast + 4 * p);
        if (seen.triangle < 0) {
            std::fill_n(to, A, T(0)), std::fill_n(da, 2 * D, T(0));
            continue;
        }
        const Corners<T> corners(attr, at, item, seen.triangle);
        for (int c = 0; c < A; ++c)
            to[c] = T(double(corners.row[2][c]) + seen.u * corners.by_u(c) + seen.v * corners.by_v(c));
        for (int k = 0; k < D; ++k) {
            const T* db = at.rast_db + 4 * p;
            const double by_u = corners.by_u(chosen[k]), by_v = corners.by_v(chosen[k]);
            da[2 * k] = T(by_u * db[0] + by_v * db[2]), da[2 * k + 1] = T(by_u * db[1] + by_v * db[3]);
        }
    }
}

// Of one pixel: cotangents of by_u and by_v are added to the corners' rows in `sums`.
template <int N, class T>
void add_to_corners(const VertexAttributes<T>& attr, const RasterView<T>& at, const std::vector<int>& chosen, int64_t p,
                    const Corners<T>& corners, const T* bar, const T* da_bar, double* sums) {
    const int A = N > 0 ? N : attr.width, D = int(chosen.size());
    const RasterPixel<T> seen(at.rast + 4 * p);
    double* row[3];
    for (int i = 0; i < 3; ++i) row[i] = sums + int64_t(corners.vertex[i]) * A;
    if (bar)
        for (int c = 0; c < A; ++c) {
            const double g = bar[p * A + c];
            row[0][c] += seen.u * g, row[1][c] += seen.v * g, row[2][c] += (1 - seen.u - seen.v) * g;
        }
    if (!da_bar) return;
    const T* db = at.rast_db + 4 * p;
    for (int k = 0; k < D; ++k) {
        const double x = da_bar[2 * (p * D + k)], y = da_bar[2 * (p * D + k) + 1];
        const double u = x * db[0] + y * db[1], v = x * db[2] + y * db[3];
        const int c = chosen[k];
        row[0][c] += u, row[1][c] += v, row[2][c] -= u + v;
    }
}

}  // namespace

template <class T>
Interpolated<T> interpolate(const VertexAttributes<T>& attr, const RasterView<T>& at, const std::vector<int>& chosen,
                            ThreadTeam& team) {
    const Frames& frames = at.frames;
    Interpolated<T> out{Array<T>(frames.pixels() * attr.width), Array<T>(frames.pixels() * 2 * int64_t(chosen.size()))};
    constexpr int64_t rows = 16;
    const int64_t all = frames.count * frames.height;
    team.parallel_for((all + rows - 1) / rows, [&](int64_t k) {
        for (int64_t r = k * rows; r < std::min(all, (k + 1) * rows); ++r)
            dispatch_channels(attr.width, false, [&]<int N>() {
                interpolate_row<N>(attr, at, chosen, r / frames.height, r * frames.width, out);
            });
    });
    return out;
}

template <class T>
InterpolateGrad<T> interpolate_vjp(const VertexAttributes<T>& attr, const RasterView<T>& at,
                                   const std::vector<int>& chosen, const T* bar, const T* da_bar,
                                   InterpolateWanted wanted, ThreadTeam& team) {
    const Frames& frames = at.frames;
    const int A = attr.width, D = int(chosen.size());
    InterpolateGrad<T> out;
    if (wanted.attr) {
        const Targets to{attr.vertices, A, attr.shared};
        // In range mode the vertices that an image uses are not known here from ranges: only from what it shows.
        const auto shares = shares_of(frames, to);
        out.attr = sums_over<T>(shares, frames, to, team, [&](const Share& share, double* sums) {
            dispatch_channels(A, false, [&]<int N>() {
                share.each_row([&](int64_t item, int64_t y) {
                    const int64_t first = (item * frames.height + y) * frames.width;
                    for (int64_t p = first; p < first + frames.width; ++p) {
                        const RasterPixel<T> seen(at.rast + 4 * p);
                        if (seen.triangle < 0) continue;
                        const Corners<T> corners(attr, at, item, seen.triangle);
                        add_to_corners<N>(attr, at, chosen, p, corners, bar, da_bar, sums);
                    }
                });
            });
        });
    }
    if (wanted.rast) out.rast.emplace(4 * frames.pixels());
    if (wanted.rast_db) out.rast_db.emplace(4 * frames.pixels());
    if (!wanted.rast && !wanted.rast_db) return out;
    team.parallel_for(frames.count * frames.height, [&](int64_t r) {
        for (int64_t p = r * frames.width; p < (r + 1) * frames.width; ++p) {
            double u = 0, v = 0, d[4] = {};
            const RasterPixel<T> seen(at.rast + 4 * p);
            if (seen.triangle >= 0) {
                const Corners<T> corners(attr, at, r / frames.height, seen.triangle);
                if (bar && wanted.rast)
                    for (int c = 0; c < A; ++c)
                        u += double(bar[p * A + c]) * corners.by_u(c), v += double(bar[p * A + c]) * corners.by_v(c);
                if (da_bar && wanted.rast_db)
                    for (int k = 0; k < D; ++k) {
                        const double x = da_bar[2 * (p * D + k)], y = da_bar[2 * (p * D + k) + 1];
                        const double by_u = corners.by_u(chosen[k]), by_v = corners.by_v(chosen[k]);
                        d[0] += by_u * x, d[1] += by_u * y, d[2] += by_v * x, d[3] += by_v * y;
                    }
            }
            if (wanted.rast) {
                T* to = out.rast->data() + 4 * p;
                to[0] = T(u), to[1] = T(v), to[2] = T(0), to[3] = T(0);
            }
            if (wanted.rast_db)
                for (int i = 0; i < 4; ++i) (*out.rast_db)[4 * p + i] = T(d[i]);
        }
    });
    return out;
}

#define EDGEGRAD_OF(T)                                                                                              \
    template Interpolated<T> interpolate(const VertexAttributes<T>&, const RasterView<T>&, const std::vector<int>&, \
                                         ThreadTeam&);                                                              \
    template InterpolateGrad<T> interpolate_vjp(const VertexAttributes<T>&, const RasterView<T>&,                   \
                                                const std::vector<int>&, const T*, const T*, InterpolateWanted,     \
                                                ThreadTeam&);
EDGEGRAD_OF(float)
EDGEGRAD_OF(double)

}  // namespace edgegrad
