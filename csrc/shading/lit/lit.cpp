#include "shading/lit/lit.h"

#include <algorithm>

#include "shading/lit/lit_radiance.h"
#include "shading/lit/point_cotangents.h"
#include "shading/lit/visibility.h"

namespace edgegrad {

std::shared_ptr<ShadeBuffers> shade_buffers(const LitScene& lit, const LitOptions& options) {
    auto buffers = std::make_shared<ShadeBuffers>();
    buffers->lights = light_samples(lit, options);
    return buffers;
}

template <class T>
void shade_some(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                const LitOptions& options, ShadeBuffers& buffers, double* radiance_out, int8_t* seen) {
    query_visibility(lit, scene, caster, points, options, buffers, seen, [](int64_t) { return true; });
    for (int64_t i = 0; radiance_out && i < points.size; ++i) {
        const size_t first = i * buffers.lights.size();
        Surface<double>& o = buffers.surfaces[i];
        if (o.scattering.lambertian) look_up_material(lit, o);
        radiance(lit, options, buffers.lights, buffers.points.data() + first, o, seen + first,
                 radiance_out + i * lit.channels);
    }
}

template <class T>
void shade(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
           const LitOptions& options, double* radiance_out, int8_t* seen, ThreadTeam& team) {
    const size_t K = light_samples(lit, options).size();
    team.parallel_for_with_state(
        (points.size + shaded_at_once - 1) / shaded_at_once, [&] { return shade_buffers(lit, options); },
        [&](ShadeBuffers& buffers, int64_t block) {
            const int64_t first = block * shaded_at_once;
            shade_some(lit, scene, caster, points.part(first, shaded_at_once), options, buffers,
                       radiance_out ? radiance_out + first * lit.channels : nullptr, seen + first * K);
        });
}

void draw_light_points(const LitScene& lit, const LitPoints& points, const LitOptions& options, int light,
                       LightPoint* out, ThreadTeam& team) {
    team.parallel_for_blocks(points.size, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            Surface<double> o;
            set_surface<double>(lit, points.face[i], points.b + 3 * i, points.spread_at(i), o);
            if (!o.scattering.lambertian) look_up_material(lit, o);
            light_points(lit, points, i, light, options.samples, options.dark, o, out + i * options.samples);
        }
    });
}

void shade_vjp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* bar, const std::vector<TableBar>& to, LitPositions<double> places, ThreadTeam& team) {
    const std::vector<LightSample> lights = light_samples(lit, options);
    clear(places, points.size);
    add_cotangents(lit, points.size, to, team, [&](int64_t first, int64_t last, Cotangents& chunk) {
        std::vector<LightPoint> of_lights(lights.size());
        for (int64_t i = first; i < last; ++i) {
            const int8_t* sees = seen + i * lights.size();
            Surface<double> o;
            set_surface<double>(lit, points.face[i], points.b + 3 * i, points.spread_at(i), o);
            if (o.is_black() || is_unlit(lit, *o.mesh, sees, lights.size())) continue;
            look_up_material(lit, o);
            light_points(lit, points, options, lights, i, o, of_lights.data());
            FacePointBar at_bar;
            radiance_vjp(lit, options, lights, of_lights.data(), o, sees, bar + i * lit.channels, at_bar, chunk);
            write(at_bar, places, i);
        }
    });
}

template <class T>
void trace_and_shade_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                         const LitPoints& points, const LitOptions& options, const double* bar,
                         const std::vector<TableBar>& to, LitPositions<double> places, ThreadTeam& team) {
    clear(places, points.size);
    add_cotangents(lit, points.size, to, team, [&](int64_t first, int64_t last, Cotangents& chunk) {
        const auto buffers = shade_buffers(lit, options);
        const size_t K = buffers->lights.size();
        std::vector<int8_t> seen(shaded_at_once * K);
        for (; first < last; first += shaded_at_once) {
            const LitPoints some = points.part(first, std::min(shaded_at_once, last - first));
            // Points with a zero cotangent are skipped, because their derivatives are zero.
            const auto wanted = [&](int64_t i) {
                const double* of_point = bar + (first + i) * lit.channels;
                return std::any_of(of_point, of_point + lit.channels, [](double x) { return x != 0; });
            };
            query_visibility(lit, scene, caster, some, options, *buffers, seen.data(), wanted);
            for (int64_t i = 0; i < some.size; ++i) {
                Surface<double>& o = buffers->surfaces[i];
                const int8_t* sees = seen.data() + i * K;
                if (!wanted(i) || o.is_black() || is_unlit(lit, *o.mesh, sees, K)) continue;
                if (o.scattering.lambertian) look_up_material(lit, o);
                FacePointBar at_bar;
                radiance_vjp(lit, options, buffers->lights, buffers->points.data() + i * K, o, sees,
                             bar + (first + i) * lit.channels, at_bar, chunk);
                write(at_bar, places, first + i);
            }
        }
    });
}

void shade_jvp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               LitPositions<const double> dot, double* radiance_dot, ThreadTeam& team) {
    const std::vector<LightSample> lights = light_samples(lit, options);
    team.parallel_for_blocks(points.size, [&](int64_t, int64_t first, int64_t last) {
        std::vector<LightPoint> of_lights(lights.size());
        for (int64_t i = first; i < last; ++i) {
            Dual total[most_lit_channels];
            const MovingPoint point(lit, points, dot, i);
            const Surface<Dual>& o = point.surface;
            if (o.mesh->has_material && !o.is_black())
                light_points(lit, points, options, lights, i, o, of_lights.data());
            radiance(lit, options, lights, of_lights.data(), o, seen + i * lights.size(), total);
            for (int c = 0; c < lit.channels; ++c) radiance_dot[i * lit.channels + c] = total[c].dot;
        }
    });
}

template void shade_some(const LitScene&, const SceneView<float>&, const RayCaster&, const LitPoints&,
                         const LitOptions&, ShadeBuffers&, double*, int8_t*);
template void shade_some(const LitScene&, const SceneView<double>&, const RayCaster&, const LitPoints&,
                         const LitOptions&, ShadeBuffers&, double*, int8_t*);
template void shade(const LitScene&, const SceneView<float>&, const RayCaster&, const LitPoints&, const LitOptions&,
                    double*, int8_t*, ThreadTeam&);
template void shade(const LitScene&, const SceneView<double>&, const RayCaster&, const LitPoints&, const LitOptions&,
                    double*, int8_t*, ThreadTeam&);
template void trace_and_shade_vjp(const LitScene&, const SceneView<float>&, const RayCaster&, const LitPoints&,
                                  const LitOptions&, const double*, const std::vector<TableBar>&, LitPositions<double>,
                                  ThreadTeam&);
template void trace_and_shade_vjp(const LitScene&, const SceneView<double>&, const RayCaster&, const LitPoints&,
                                  const LitOptions&, const double*, const std::vector<TableBar>&, LitPositions<double>,
                                  ThreadTeam&);

}  // namespace edgegrad
