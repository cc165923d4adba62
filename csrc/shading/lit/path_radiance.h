// Evaluates the radiance that a path carries to the viewer of its first point x₁, and the _vjp. With the direct light
// D_k that x_k scatters along the path,
//
//     L_k = D_k + f(x_k) (n_k · l_k) |M_{k+1} · d_k| / |d_k|³ / p_{k+1} · L_{k+1},
//     d_k = x_{k+1} − x_k,  l_k = d_k / |d_k|
//
// where p_{k+1} is the pdf of the barycentrics of x_{k+1}, and M_{k+1} the cross product of two sides of its face. D₁
// is left to lit_radiance.h.
#pragma once

#include <algorithm>
#include <vector>

#include "shading/lit/lit_radiance.h"
#include "shading/lit/path.h"

namespace edgegrad {

// Holds one step of a path from o to next: the BSDF f, and the factors that multiply it.
template <class S>
struct Step {
    Vector<S> d, l;
    S f[most_lit_channels], cosine, terminated = 1, measure;

    Step(const LitScene& lit, const Surface<S>& o, const Surface<S>& next, double pdf) {
        d = next.y - o.y, l = unit(d), cosine = dot(o.n, l);
        scatter(o.scattering, o.v, o.n, l, lit.channels, f);
        if (!o.mesh->normal.is_flat()) terminated = terminator<S>(o.g, o.n, l);
        measure = S(1 / pdf) * solid_angle(next, d);
    }
    S factor() const { return cosine * terminated * measure; }
};
// Adds the cotangents of one step, which maps the radiance `from` to f · factor · from.
inline void step_vjp(const LitScene& lit, const Surface<double>& o, const Surface<double>& next,
                     const Step<double>& step, const double* from, const double* to_bar, SurfaceBar& bar,
                     SurfaceBar& next_bar) {
    const double factor = step.factor();
    double f_bar[most_lit_channels], factor_bar = 0;
    for (int c = 0; c < lit.channels; ++c)
        f_bar[c] = to_bar[c] * factor * from[c], factor_bar += to_bar[c] * step.f[c] * from[c];
    Vec3 l_bar, d_bar, M_bar;
    scatter_vjp(o.scattering, o.v, o.n, step.l, lit.channels, f_bar, bar.scattering, bar.v, bar.n, l_bar);
    dot_vjp(o.n, step.l, factor_bar * step.terminated * step.measure, bar.n, l_bar);
    if (!o.mesh->normal.is_flat())
        terminator_vjp(o.g, o.n, step.l, factor_bar * step.cosine * step.measure, bar.g, bar.n, l_bar);
    // The next lines differentiate |M · d| / |d|³.
    const Vec3 e1 = next.frame.corner[1] - next.frame.corner[0], e2 = next.frame.corner[2] - next.frame.corner[0];
    const Vec3 M = cross(e1, e2);
    const double whole_bar = factor_bar * factor;  // cotangent of the factor's logarithm
    dot_vjp(M, step.d, whole_bar / dot(M, step.d), M_bar, d_bar);
    d_bar -= 3 * whole_bar / dot(step.d, step.d) * step.d;
    Vec3 e1_bar, e2_bar;
    cross_vjp(e1, e2, M_bar, e1_bar, e2_bar);
    next_bar.frame.corner[0] -= e1_bar + e2_bar;
    next_bar.frame.corner[1] += e1_bar, next_bar.frame.corner[2] += e2_bar;
    d_bar += unit_vjp(step.d, l_bar);
    next_bar.y += d_bar, bar.y -= d_bar;
}

// Adds the direct light that a point scatters: from its light samples, and from the emitter that the path hits.
template <class S>
void add_sampled_light(const LitScene& lit, const std::vector<LightSample>& lights, const Path& path, int k,
                       const Surface<S>& o, S* total) {
    add_unshadowed(lit, o, total);
    add_lights(lit, lights, path.drawn_at(k), o, path.seen_at(k), total);
}
template <class S>
void add_emitter_hit(const LitScene& lit, const Path& path, int k, const Surface<S>& o, S* total) {
    if (path.has_emitter_hit(k))
        add_light(lit, lit.lights[path.emitter_hit_at(k).light], path.emitter_hit_at(k).point, 1.0, o, total);
}
template <class S>
void add_direct(const LitScene& lit, const std::vector<LightSample>& lights, const Path& path, int k,
                const Surface<S>& o, S* total) {
    add_sampled_light(lit, lights, path, k, o, total), add_emitter_hit(lit, path, k, o, total);
}

// Writes the radiance (channels,) of a path with the surfaces at(k).
template <class S, class At>
void path_radiance(const LitScene& lit, const std::vector<LightSample>& lights, const Path& path, At at, S* total) {
    const int C = lit.channels;
    std::fill(total, total + C, S(0));
    for (int k = path.points - 1; k >= 0; --k) {
        const Surface<S>& o = at(k);
        if (k + 1 < path.points) {
            const Step<S> step(lit, o, at(k + 1), path.pdf_at(k + 1));
            const S factor = step.factor();
            for (int c = 0; c < C; ++c) total[c] *= step.f[c] * factor;
        }
        if (k > 0) add_direct(lit, lights, path, k, o, total);
    }
}

// Returns the points of a path as dual numbers, moving in one direction; `first` is the first point.
inline std::vector<Surface<Dual>> moving_surfaces(const LitScene& lit, const Path& path, const Surface<Dual>& first) {
    std::vector<Surface<Dual>> surfaces(std::max(1, path.points));
    surfaces[0] = first;
    for (int k = 1; k < path.points; ++k) {
        const double* b = path.b_at(k);
        const Dual fixed[3] = {b[0], b[1], b[2]};
        set_place<Dual>(lit, path.face_at(k), fixed, nullptr, surfaces[k]);
        set_view<Dual>(lit, unit(surfaces[k - 1].y - surfaces[k].y), surfaces[k]);
        look_up_material(lit, surfaces[k]);
    }
    return surfaces;
}

// Holds memory that calls of path_radiance_vjp() reuse.
struct PathBuffers {
    std::vector<Step<double>> steps;
    std::vector<double> L, L_bar;  // Each point has a row.
    std::vector<SurfaceBar> bars;
};

// Adds to the cotangents of the tables, and writes the cotangent of the first point's position.
template <class At>
void path_radiance_vjp(const LitScene& lit, const std::vector<LightSample>& lights, const Path& path, At at,
                       const double* total_bar, PathBuffers& own, FacePointBar& at_bar, Cotangents& to) {
    const int n = path.points, C = lit.channels;
    own.steps.clear(), own.L.assign(n * C, 0.0), own.L_bar.assign(n * C, 0.0), own.bars.assign(n, SurfaceBar(C));
    for (int k = 0; k + 1 < n; ++k) own.steps.emplace_back(lit, at(k), at(k + 1), path.pdf_at(k + 1));
    for (int k = n - 1; k > 0; --k) {
        double* L = &own.L[k * C];
        if (k + 1 < n) {
            const double factor = own.steps[k].factor();
            for (int c = 0; c < C; ++c) L[c] = own.steps[k].f[c] * factor * own.L[(k + 1) * C + c];
        }
        add_direct(lit, lights, path, k, at(k), L);
    }
    std::copy(total_bar, total_bar + C, own.L_bar.begin());
    for (int k = 0; k + 1 < n; ++k) {
        const double factor = own.steps[k].factor();
        for (int c = 0; c < C; ++c) own.L_bar[(k + 1) * C + c] = own.L_bar[k * C + c] * own.steps[k].f[c] * factor;
    }
    // The loop runs from the last point to the first, because each point is viewed from the one before.
    for (int k = n - 1; k >= 0; --k) {
        const Surface<double>& o = at(k);
        const double* L_bar = &own.L_bar[k * C];
        SurfaceBar& bar = own.bars[k];
        if (k + 1 < n) step_vjp(lit, o, at(k + 1), own.steps[k], &own.L[(k + 1) * C], L_bar, bar, own.bars[k + 1]);
        if (k > 0) {
            add_unshadowed_vjp(lit, o, L_bar, bar, to);
            add_lights_vjp(lit, lights, path.drawn_at(k), o, path.seen_at(k), L_bar, bar, to);
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        const Surface<double>& o = at(k);
        SurfaceBar& bar = own.bars[k];
        look_up_material_vjp(lit, o, bar, to);
        if (k > 0) {
            const Vec3 away_bar = unit_vjp(at(k - 1).y - o.y, bar.v);
            own.bars[k - 1].y += away_bar, bar.y -= away_bar;
        } else {
            view_vjp(lit, o, bar, to);
        }
        place_vjp(lit, o, bar, to);
    }
    if (n > 0) at_bar = own.bars[0].at;
}

}  // namespace edgegrad
