#include "shading/lit/indirect.h"

#include <algorithm>

#include "shading/lit/lit.h"
#include "shading/lit/near_field.h"
#include "shading/lit/path_radiance.h"
#include "shading/lit/point_cotangents.h"

namespace edgegrad {

std::shared_ptr<Paths> path_buffers(const LitScene& lit, const LitOptions& options) {
    return std::make_shared<Paths>(lit, options);
}

template <class T>
void shade_by_paths(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                    Paths& paths, double* out, int8_t* seen) {
    paths.find_for_image(scene, caster, points);
    const size_t K = paths.lights().size();
    double along[most_lit_channels];
    for (int64_t i = 0; i < points.size; ++i) {
        double* total = out + i * lit.channels;
        std::fill(total, total + lit.channels, 0.0);
        const int64_t own = paths_of_point * i;
        for (int64_t j = own; j < own + paths_of_point; ++j) {
            const Path path = paths.path(j);
            const auto at = [&](int k) -> const Surface<double>& { return paths.surface(j, k); };
            path_radiance(lit, paths.lights(), path, at, along);
            for (int c = 0; c < lit.channels; ++c) total[c] += along[c] / paths_of_point;
            if (path.points > 0) add_emitter_hit(lit, path, 0, at(0), total);
        }
        const Path path = paths.path(own);
        if (path.points > 0) {
            add_sampled_light(lit, paths.lights(), path, 0, paths.surface(own, 0), total);
            std::copy(path.seen_at(0), path.seen_at(0) + K, seen + i * K);
        } else {
            std::fill(seen + i * K, seen + (i + 1) * K, not_sampled);
        }
        if (Surface<double> first = paths.surface(own, 0); !first.is_black()) {
            if (!first.mesh->has_material) look_up_material(lit, first);
            add_own_radiance(lit, first, total);
        }
    }
}

namespace {

// Removes the near part from the cotangent of the first point's position on its face.
template <class At>
void remove_near_field(const LitScene& lit, const LitOptions& options, At at, const double* total_bar,
                       const PathBuffers& found, FacePointBar& at_bar) {
    const NearField near(options.near);
    const Surface<double>& o = at(0);
    const Vec3 d = at(1).y - o.y;
    if (!(near.share(d) > 0)) return;
    double carried = 0;
    const double factor = found.steps[0].factor();
    for (int c = 0; c < lit.channels; ++c)
        carried += total_bar[c] * found.steps[0].f[c] * factor * found.L[lit.channels + c];
    const Vec3 away = carried * near.slope(d);  // −∂φ/∂x₁
    for (int i = 0; i < 3; ++i) at_bar.b[i] = (1 - near.share(d)) * at_bar.b[i] + dot(away, o.frame.corner[i]);
}

}  // namespace

template <class T>
void add_indirect(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  Paths& paths, double* out) {
    paths.find(scene, caster, points, [](int64_t) { return true; });
    double total[most_lit_channels];
    for (int64_t i = 0; i < points.size; ++i) {
        const auto at = [&](int k) -> const Surface<double>& { return paths.surface(i, k); };
        const Path path = paths.path(i);
        path_radiance(lit, paths.lights(), path, at, total);
        double share = 1;
        if (paths.options().only_near_field)
            share = path.points > 1 ? NearField(paths.options().near).share(at(1).y - at(0).y) : 0;
        for (int c = 0; c < lit.channels; ++c) out[i * lit.channels + c] += share * total[c];
    }
}

template <class T>
void indirect(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
              const LitOptions& options, double* out, ThreadTeam& team) {
    std::fill(out, out + points.size * lit.channels, 0.0);
    team.parallel_for_with_state(
        (points.size + shaded_at_once - 1) / shaded_at_once, [&] { return path_buffers(lit, options); },
        [&](Paths& paths, int64_t block) {
            team.check();
            const int64_t first = block * shaded_at_once;
            add_indirect(lit, scene, caster, points.part(first, shaded_at_once), paths, out + first * lit.channels);
        });
}

template <class T>
void indirect_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, const double* bar, const std::vector<TableBar>& to,
                  LitPositions<double> places, ThreadTeam& team) {
    clear(places, points.size);
    add_cotangents(lit, points.size, to, team, [&](int64_t first, int64_t last, Cotangents& chunk) {
        Paths paths(lit, options);
        PathBuffers buffers;
        for (; first < last; first += shaded_at_once) {
            team.check();
            const LitPoints some = points.part(first, std::min(shaded_at_once, last - first));
            const auto wanted = [&](int64_t i) {
                const double* of_point = bar + (first + i) * lit.channels;
                return std::any_of(of_point, of_point + lit.channels, [](double x) { return x != 0; });
            };
            paths.find(scene, caster, some, wanted);
            for (int64_t i = 0; i < some.size; ++i) {
                const Path path = paths.path(i);
                if (path.points < 2) continue;
                const auto at = [&](int k) -> const Surface<double>& { return paths.surface(i, k); };
                FacePointBar at_bar;
                path_radiance_vjp(lit, paths.lights(), path, at, bar + (first + i) * lit.channels, buffers, at_bar,
                                  chunk);
                if (options.near > 0)
                    remove_near_field(lit, options, at, bar + (first + i) * lit.channels, buffers, at_bar);
                write(at_bar, places, first + i);
            }
        }
    });
}

template <class T>
void indirect_jvp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, LitPositions<const double> dot, double* radiance_dot, ThreadTeam& team) {
    team.parallel_for_with_state(
        (points.size + shaded_at_once - 1) / shaded_at_once, [&] { return path_buffers(lit, options); },
        [&](Paths& paths, int64_t block) {
            team.check();
            const int64_t first = block * shaded_at_once;
            const LitPoints some = points.part(first, shaded_at_once);
            paths.find(scene, caster, some, [](int64_t) { return true; });
            for (int64_t i = 0; i < some.size; ++i) {
                const Path path = paths.path(i);
                double* out = radiance_dot + (first + i) * lit.channels;
                const auto find = [&](LitPositions<const double> own, Dual* total) {
                    const MovingPoint point(lit, points, own, first + i);
                    const std::vector<Surface<Dual>> surfaces = moving_surfaces(lit, path, point.surface);
                    const auto at = [&](int k) -> const Surface<Dual>& { return surfaces[k]; };
                    path_radiance(lit, paths.lights(), path, at, total);
                };
                Dual total[most_lit_channels], held[most_lit_channels];
                find(dot, total);
                for (int c = 0; c < lit.channels; ++c) out[c] = total[c].dot;
                if (!(options.near > 0) || !dot.b || path.points < 2) continue;
                // Removes the near part as the point slides, like remove_near_field().
                const Vec3 d = paths.surface(i, 1).y - paths.surface(i, 0).y;
                const NearField near(options.near);
                Vec3 slid;
                for (int k = 0; k < 3; ++k) slid += dot.b[3 * (first + i) + k] * paths.surface(i, 0).frame.corner[k];
                find({nullptr, dot.spread}, held);
                for (int c = 0; c < lit.channels; ++c)
                    out[c] += near.share(d) * (held[c].dot - total[c].dot) +
                              edgegrad::dot(near.slope(d), slid) * total[c].value;
            }
        });
}

#define EDGEGRAD_INDIRECT(T)                                                                                         \
    template void indirect(const LitScene&, const SceneView<T>&, const RayCaster&, const LitPoints&,                 \
                           const LitOptions&, double*, ThreadTeam&);                                                 \
    template void shade_by_paths(const LitScene&, const SceneView<T>&, const RayCaster&, const LitPoints&, Paths&,   \
                                 double*, int8_t*);                                                                  \
    template void add_indirect(const LitScene&, const SceneView<T>&, const RayCaster&, const LitPoints&, Paths&,     \
                               double*);                                                                             \
    template void indirect_vjp(const LitScene&, const SceneView<T>&, const RayCaster&, const LitPoints&,             \
                               const LitOptions&, const double*, const std::vector<TableBar>&, LitPositions<double>, \
                               ThreadTeam&);                                                                         \
    template void indirect_jvp(const LitScene&, const SceneView<T>&, const RayCaster&, const LitPoints&,             \
                               const LitOptions&, LitPositions<const double>, double*, ThreadTeam&);
EDGEGRAD_INDIRECT(float)
EDGEGRAD_INDIRECT(double)

}  // namespace edgegrad
