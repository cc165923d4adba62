// Holds what derivatives at surface points share: cotangents of positions and tables, and points that move.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/parallel.h"
#include "shading/lit/lit_surface.h"

namespace edgegrad {

inline void clear(LitPositions<double> places, int64_t points) {
    std::fill(places.b, places.b + 3 * points, 0.0);
    if (places.spread) std::fill(places.spread, places.spread + spread_size * points, 0.0);
}
inline void write(const FacePointBar& bar, LitPositions<double> places, int64_t i) {
    std::copy(bar.b, bar.b + 3, places.b + 3 * i);
    if (places.spread) std::copy(bar.spread, bar.spread + spread_size, places.spread + spread_size * i);
}

// Calls body(first, last, cotangents) for chunks of points, and adds up the cotangents.
template <class Body>
void add_cotangents(const LitScene& lit, int64_t points, const std::vector<TableBar>& to, ThreadTeam& team, Body body) {
    std::vector<Cotangents> chunks;
    double seconds[2] = {};
    scatter_in_waves(
        team, points, chunks, [&](Cotangents& chunk, int owners) { chunk.prepare(lit.tables, to, owners); }, body,
        [&](const Cotangents& chunk, int owner) { chunk.add_to(to, owner); }, [](Cotangents&) {}, seconds);
}

// Holds point i with the tangent of its position. It refers to itself, and so cannot be copied.
struct MovingPoint {
    MovingPoint(const LitScene& lit, const LitPoints& points, LitPositions<const double> dot, int64_t i) {
        Dual b[3];
        set(3 * i, 3, points.b, dot.b, b);
        set(spread_size * i, spread_size, points.spread, dot.spread, spread);
        set_surface<Dual>(lit, points.face[i], b, points.spread ? spread : nullptr, surface);
        look_up_material(lit, surface);
    }
    MovingPoint(const MovingPoint&) = delete;
    MovingPoint& operator=(const MovingPoint&) = delete;

    Surface<Dual> surface;

   private:
    static void set(int64_t first, int n, const double* value, const double* tangent, Dual* to) {
        for (int k = 0; value && k < n; ++k) to[k] = {value[first + k], tangent ? tangent[first + k] : 0};
    }
    Dual spread[spread_size];
};

}  // namespace edgegrad
