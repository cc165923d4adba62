// What punctual lights give to flat faces, at their corners: numbers that differ at an edge where radiance may jump.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// Faces as a viewer sees them.
struct FlatFaces {
    const double* verts;
    const int32_t* faces;
    int64_t n_verts, n_faces;
    Vec3 eye;  // in an orthographic view, the unit direction towards it
    bool perspective;
};

struct PunctualLight {
    Vec3 place;  // at infinity, the unit direction towards it
    bool infinite;
    double power;  // W/sr, or at infinity W/m²

    // The irradiance at normal incidence, over the distance |l|.
    double arriving_over_distance(Vec3 at) const {
        if (infinite) return power;
        const double squared = dot(place - at, place - at);
        return squared > 0 ? power / (squared * std::sqrt(squared)) : 0;
    }
};

// Cosine, below which it is left open which side of a face is seen.
constexpr double edge_on = 1e-3;

// (F, 3, L): E max(0, n·l) for the normal n on the viewer's side, over the greatest of all. It is the same at both ends
// of an edge only if it is along all of it, as n·l has the sign, and over 1/|l| the size, of a face's distance to the
// light.
inline Array<double> light_on_flat_faces(const FlatFaces& of, const std::vector<PunctualLight>& lights,
                                         ThreadTeam& team) {
    const auto at = [&](int32_t v) {
        const double* p = of.verts + 3 * int64_t(v);
        return Vec3{p[0], p[1], p[2]};
    };
    const int64_t L = int64_t(lights.size());
    Array<double> out(3 * of.n_faces * L);
    const std::vector<double> greatest = team.map_blocks(of.n_faces, [&](int64_t first, int64_t last) {
        double most = 0;
        for (int64_t f = first; f < last; ++f) {
            const int32_t* v = of.faces + 3 * f;
            const Vec3 corner[3] = {at(v[0]), at(v[1]), at(v[2])};
            const Vec3 m = cross(corner[1] - corner[0], corner[2] - corner[0]), to_eye = of.eye - corner[0];
            const double size = length(m);
            const Vec3 g = size > 0 ? (1 / size) * m : Vec3();
            const double towards = dot(g, of.perspective ? (1 / length(to_eye)) * to_eye : of.eye);
            const Vec3 n = towards < 0 ? -g : g;
            for (int64_t l = 0; l < L; ++l) {
                const PunctualLight& light = lights[l];
                const double d = dot(n, light.infinite ? light.place : light.place - corner[0]);
                const double distance = std::fabs(towards) < edge_on ? std::fabs(d) : std::max(d, 0.0);
                for (int i = 0; i < 3; ++i) {
                    const double irradiance = distance * light.arriving_over_distance(corner[i]);
                    out[(3 * f + i) * L + l] = irradiance;
                    most = std::max(most, irradiance);
                }
            }
        }
        return most;
    });
    const double scale = 1 / std::max(*std::max_element(greatest.begin(), greatest.end()), 1e-300);
    team.parallel_for_blocks(out.size(), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) out[i] *= scale;
    });
    return out;
}

}  // namespace edgegrad
