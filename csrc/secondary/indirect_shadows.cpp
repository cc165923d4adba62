// This file draws samples on indirect shadow boundaries, by the area that these sweep on surfaces.
//
// Let F = N · (y − p) as in shadow_source.h, with y at fixed barycentrics of the receiver, which has the unit normal g.
// Then
//
//     δF = N · (Σ β_i δv_i − w_a δa − w_b δb − w_l δl).
//
// On the receiver |∇F| = |N × g|, and per unit of t on the edge the boundary has the length S |g × N| / |g·d|. The
// light that the surface gets therefore changes by
//
//     ∫ [L(F > 0) − L(F < 0)] δF / |∇F| dℓ = ∫ [L(F > 0) − L(F < 0)] δF S / |g·d| dt.
//
// Samples are drawn as in shadows.cpp, but without weights by the image: the camera need not see them.

#include "secondary/indirect_shadows.h"

#include <cmath>

#include "secondary/estimator.h"
#include "secondary/shadow_samples.h"
#include "secondary/shadow_source.h"

namespace edgegrad {

namespace {

// BorderOnFace is a shadow boundary on a receiver, in world coordinates.
template <class T>
struct BorderOnFace {
    const SceneView<T>& scene;
    const ShadowPoint& point;
    ShadowBorder border;
    Vec3 g, y;

    BorderOnFace(const SceneView<T>& scene_, const LightParts& light, const ShadowPoint& point_)
        : scene(scene_), point(point_) {
        border = ShadowBorder::of(point, light.infinite, point.light, [&](int32_t i) {
            const double* v = scene.verts + 3 * int64_t(i);
            return Vec3{v[0], v[1], v[2]};
        });
        Vec3 v[3];
        for (int i = 0; i < 3; ++i) v[i] = corner(scene, point.face, i), y += point.on[i] * v[i];
        g = unit(cross(v[1] - v[0], v[2] - v[0]));
    }
    // Returns the area per unit of F and t.
    double scale() const { return border.S / std::fabs(dot(g, border.d)); }

    void append_to(CurveRecords& records, double weight) const {
        const double factor = (point.side < 0 ? 1 : -1) * weight * scale();
        if (!std::isfinite(factor)) return;
        const int64_t sample = records.size();
        append(records.x, {0.0, 0.0});
        for (int k = 0; k < CurveRecords::surfaces; ++k) {
            const bool lit = k == 0;
            records.face.push_back(lit ? point.face : -2), records.factor.push_back(lit ? factor : 0);
            append(records.b, {point.on.u, point.on.v});
        }
        const auto add_vertex = [&](int32_t vertex, double by) {
            records.row_of.push_back(sample), records.vertex.push_back(vertex);
            append(records.by_q, {by * border.N.x, by * border.N.y, by * border.N.z});
        };
        for (int i = 0; i < 3; ++i) add_vertex(scene.faces[3 * int64_t(point.face) + i], point.on[i]);
        const Occluder& caster = point.caster;
        for (int i = 0; i < caster.count; ++i) add_vertex(caster.vertex[i], -border.by_caster[i]);
        caster.append_alpha_edge(border.by_alpha_edge, sample, records);
        const Vec3 by_light = -border.by_light * border.N;
        records.light.push_back(point.part), append(records.light_uv, {point.uv.x, point.uv.y});
        append(records.by_light, {by_light.x, by_light.y, by_light.z});
    }
};

}  // namespace

template <class T>
void add_indirect_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light,
                          int64_t samples, GradientSink& to) {
    if (samples == 0) return;
    ShadowSampler<T> sampler(view, casters, light,
                             {.pilots = Stream::indirect_shadow_pilots,
                              .places = Stream::indirect_shadow_places,
                              .rays = Stream::indirect_shadow_rays},
                             samples);
    const auto pilot = [&](const ShadowPoint& point, double weight) {
        const BorderOnFace<T> on(view.scene, light, point);
        const double cosine = std::fabs(dot(on.g, on.border.d)) / length(on.border.d);
        return ShadowPilot{on.border.swept(weight * on.scale(), point.caster) * cosine *
                           light.towards(point.part, point.light, on.y)};
    };
    const auto append_sample = [&](const ShadowPoint& point, double weight, CurveRecords& records) {
        BorderOnFace<T>(view.scene, light, point).append_to(records, weight);
    };
    record_secondary(view, sampler, CurvesOnSurfaces(append_sample, pilot), [&] { return samples; }, to);
}

template void add_indirect_shadows(const BackwardView<float>&, const SceneView<float>&, const LightParts&, int64_t,
                                   GradientSink&);
template void add_indirect_shadows(const BackwardView<double>&, const SceneView<double>&, const LightParts&, int64_t,
                                   GradientSink&);

}  // namespace edgegrad
