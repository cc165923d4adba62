// Light samples: points of lights that light a surface, and what one of them adds to its radiance.
#pragma once

#include <cstdint>
#include <vector>

#include "shading/lit/environment.h"
#include "shading/lit/lit_surface.h"
#include "shading/lit/lobe_draw.h"
#include "shading/lit/punctual.h"

namespace edgegrad {

// What arrives at y from a point of a light.
template <class S>
Arriving<S> arriving(const LitScene& lit, const Lamp& lamp, const LightPoint& point, Vector<S> y) {
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return from_direction<S>(lit.tables, lamp, lit.channels);
        case Lamp::Kind::environment:
            return from_environment<S>(lit.tables, lamp, lit.channels, point);
        case Lamp::Kind::mesh:
            return from_faces<S>(lit.tables, lit.emitter(lamp), point, lit.channels, y);
        default:
            return from_point<S>(lit.tables, lamp, lit.channels, y);
    }
}
inline void arriving_vjp(const LitScene& lit, const Lamp& lamp, const LightPoint& point, Vec3 y,
                         const Arriving<double>& bar, Vec3& y_bar, Cotangents& to) {
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return from_direction_vjp(lit.tables, lamp, lit.channels, bar, to);
        case Lamp::Kind::environment:
            return from_environment_vjp(lit.tables, lamp, lit.channels, point, bar, to);
        case Lamp::Kind::mesh:
            return from_faces_vjp(lit.tables, lit.emitter(lamp), point, lit.channels, y, bar, y_bar, to);
        default:
            return from_point_vjp(lit.tables, lamp, lit.channels, y, bar, y_bar, to);
    }
}

// The place of a point of a light; of one at infinity, the unit direction towards it.
inline Vec3 place(const LitScene& lit, const Lamp& lamp, const LightPoint& p) {
    const std::vector<Table>& tables = lit.tables;
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return -unit(direction_of<double>(tables, lamp));
        case Lamp::Kind::environment:
            return unit(Rotation<double>::of(tables, lamp).to_world(own_direction(lamp, p)));
        case Lamp::Kind::mesh: {
            const EmissiveFaces from = lit.emitter(lamp);
            const FacePoint<double> at = on_emitter<double>(from, p);
            Vec3 sum;
            for (int i = 0; i < 3; ++i) sum += at.b[i] * tables[lit.verts].vector_at<double>(at.vertex[i]);
            return sum;
        }
        default:
            return tables[lamp.position].vector_at<double>(0);
    }
}

// The point of an environment in a direction that lies above a surface, drawn by the light and mirrored up there, or drawn
// by the lobe. Its density is the one that the power heuristic leaves (Veach and Guibas 1995): p / w, w = p² / Σ p²,
// of as many draws by the one as by the other.
inline LightPoint combined(LightPoint p, double by_light, double by_lobe, bool of_lobe) {
    const double own = of_lobe ? by_lobe : by_light;
    p.density = own > 0 ? (by_light * by_light + by_lobe * by_lobe) / own : 0;
    return p;
}

// The point of a light that point i of a surface is lit by. It does not exist where a lobe is wanted of what has none.
template <class S>
LightPoint light_point(const LitScene& lit, const LitPoints& points, int64_t i, const LightSample& which,
                       const Surface<S>& o) {
    const Lamp& lamp = lit.lamps[which.lamp];
    if (lamp.is_punctual()) return {};
    const ForcedLight& forced = points.forced;
    const LightPoint nowhere{0, 0, 0, 0};
    if (forced.lamp == which.lamp)
        return which.by_lobe ? nowhere
                             : LightPoint{forced.index[i], forced.uv[2 * i], forced.uv[2 * i + 1], forced.density[i]};
    // Numbers that fill the unit cube evenly (edgegrad/points/seeds.py).
    const uint64_t seed = uint64_t(points.seed[i]) * uint64_t(which.count) + uint64_t(which.sample);
    const auto number = [&](int k) { return double((seed * lit.step[k % 3] + lamp.stream[k]) >> 11) * 0x1p-53; };
    if (lamp.kind == Lamp::Kind::mesh) {
        const double u[3] = {number(0), number(1), number(2)};
        return draw(lamp, u);
    }
    const Vec3 g = plain(o.g);
    const DrawnLobe lobe(o);
    if (which.by_lobe) {
        if (!lobe.exists()) return nowhere;
        const Vec3 l = lobe.draw(number(3), number(4));
        const LightPoint p = point_towards(lit.tables, lamp, l);
        return combined(p, above(lit.tables, lamp, p, g).density, lobe.density(l), true);
    }
    const double u[3] = {number(0), number(1), number(2)};
    const LightPoint p = above(lit.tables, lamp, draw(lamp, u), g);
    return lobe.exists() ? combined(p, p.density, lobe.density(place(lit, lamp, p)), false) : p;
}

// What one light sample adds, before it is known to be seen: f E max(0, n·l).
template <class S>
void add_light(const LitScene& lit, const Lamp& lamp, const LightPoint& point, double share, const Surface<S>& o,
               S* total) {
    const Arriving<S> a = arriving<S>(lit, lamp, point, o.y);
    S f[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    S cosine = S(share) * dot(o.n, a.l);
    if (!o.mesh->normal.is_flat()) cosine *= terminator<S>(o.g, o.n, a.l);
    for (int c = 0; c < lit.channels; ++c) total[c] += f[c] * a.E[c] * cosine;
}
inline void add_light_vjp(const LitScene& lit, const Lamp& lamp, const LightPoint& point, double share,
                          const Surface<double>& o, const double* total_bar, SurfaceBar& bar, Cotangents& to) {
    const Arriving<double> a = arriving<double>(lit, lamp, point, o.y);
    double f[most_lit_channels], f_bar[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    const double nl = dot(o.n, a.l), t = o.mesh->normal.is_flat() ? 1 : terminator<double>(o.g, o.n, a.l);
    Arriving<double> a_bar;
    double cosine_bar = 0;
    for (int c = 0; c < lit.channels; ++c) {
        cosine_bar += total_bar[c] * f[c] * a.E[c];
        f_bar[c] = total_bar[c] * a.E[c] * share * nl * t, a_bar.E[c] = total_bar[c] * f[c] * share * nl * t;
    }
    scatter_vjp(o.scattering, o.v, o.n, a.l, lit.channels, f_bar, bar.scattering, bar.v, bar.n, a_bar.l);
    dot_vjp(o.n, a.l, cosine_bar * share * t, bar.n, a_bar.l);
    if (!o.mesh->normal.is_flat()) terminator_vjp(o.g, o.n, a.l, cosine_bar * share * nl, bar.g, bar.n, a_bar.l);
    arriving_vjp(lit, lamp, point, o.y, a_bar, bar.y, to);
}

}  // namespace edgegrad
