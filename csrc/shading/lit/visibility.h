// Queries visibility: which light samples the points of surfaces see.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "rays/alpha_mask.h"
#include "rays/raycast.h"
#include "rays/trace.h"
#include "scene/scene.h"
#include "shading/lit/derivative_points.h"

namespace edgegrad {

// Holds shadow rays from surface points to points of lights.
struct ShadowRays {
    std::vector<int32_t> face;
    std::vector<double> b, to, contact;
    std::vector<int8_t*> result;
    std::vector<uint8_t> found;

    void clear() { face.clear(), b.clear(), to.clear(), contact.clear(), result.clear(); }
    void add(const LitScene& lit, const Light& light, int64_t face_, const Surface<double>& o, Vec3 there,
             int8_t* seen) {
        const auto largest = [](Vec3 v) { return std::max({std::fabs(v.x), std::fabs(v.y), std::fabs(v.z)}); };
        double size = largest(o.y);
        if (light.is_infinite()) there = o.y + (length(o.y - lit.center) + 1.01 * lit.radius) * there;
        else size = std::max(size, largest(there));
        face.push_back(int32_t(face_)), result.push_back(seen), contact.push_back(16 * light.eps * size);
        b.insert(b.end(), {o.at.b[1], o.at.b[2]}), to.insert(to.end(), {there.x, there.y, there.z});
    }
    template <class T>
    void cast(const SceneView<T>& scene, const RayCaster& caster) {
        found.resize(face.size());
        test_visibility(scene, caster, {face.data(), b.data(), to.data(), contact.data(), int64_t(face.size())},
                        found.data());
        for (size_t k = 0; k < found.size(); ++k) *result[k] = int8_t(found[k]);
        clear();
    }
};

// Holds memory that queries reuse.
struct ShadeBuffers {
    std::vector<LightSample> lights;
    std::vector<Surface<double>> surfaces;
    std::vector<LightPoint> points;  // Each surface has a row of points of lights.
    ShadowRays rays;
};

// Holds surfaces and, in a row for each, its sampled points of lights and which of them it sees.
struct LightQuery {
    Surface<double>* surfaces;
    LightPoint* drawn;
    int8_t* seen;
};

// Samples points of lights for the surfaces at the points that are `wanted`, and finds which of them are visible.
template <class T, class Wanted>
void query_lights(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                  const LitOptions& options, const std::vector<LightSample>& lights, const LightQuery& query,
                  ShadowRays& rays, Wanted wanted) {
    const size_t K = lights.size();
    for (int64_t i = 0; i < points.size; ++i)
        if (wanted(i)) {
            Surface<double>& o = query.surfaces[i];
            if (!o.mesh->has_material || o.is_black()) continue;
            if (!o.scattering.lambertian) look_up_material(lit, o);
            light_points(lit, points, options, lights, i, o, query.drawn + i * K);
        }
    // The loop goes light by light, because similar rays are faster to trace together.
    for (size_t k = 0; k < K; ++k) {
        const Light& light = lit.lights[lights[k].light];
        const Vec3 only_place = light.is_punctual() ? place(lit, light, {}) : Vec3();
        for (int64_t i = 0; i < points.size; ++i) {
            if (!wanted(i)) continue;
            const Surface<double>& o = query.surfaces[i];
            int8_t& found = query.seen[i * K + k] = not_sampled;
            if (!o.mesh->has_material || o.is_black()) continue;
            if (lights[k].light == options.by_paths && o.scattering.lambertian) {
                found = 0;
                continue;
            }
            const LightPoint& point = query.drawn[i * K + k];
            if (!point.exists()) continue;
            if (light.kind == Light::Kind::mesh &&
                !shows(scene, lit.emitter(light).first + point.index, {point.u, point.v}))
                continue;  // The light is transparent there (alpha-tested).
            const Vec3 there = light.is_punctual() ? only_place : place(lit, light, point);
            const Vec3 l = light.is_infinite() ? there : unit(there - o.y);
            if (!(dot(o.n, l) > 0 && dot(o.g, l) > 0)) continue;
            found = 1;
            if (!options.shadows) continue;
            if (points.forced.light == lights[k].light) found = int8_t(points.forced.lit[i]);
            else rays.add(lit, light, points.face[i], o, there, &found);
        }
    }
    rays.cast(scene, caster);
}

// Sets the surfaces at points that are `wanted`, and finds the lights they see.
template <class T, class Wanted>
void query_visibility(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                      const LitOptions& options, ShadeBuffers& buffers, int8_t* seen, Wanted wanted) {
    buffers.surfaces.resize(points.size), buffers.points.resize(points.size * buffers.lights.size());
    for (int64_t i = 0; i < points.size; ++i)
        if (wanted(i))
            set_surface<double>(lit, points.face[i], points.b + 3 * i, points.spread_at(i), buffers.surfaces[i]);
    query_lights(lit, scene, caster, points, options, buffers.lights,
                 {buffers.surfaces.data(), buffers.points.data(), seen}, buffers.rays, wanted);
}

}  // namespace edgegrad
