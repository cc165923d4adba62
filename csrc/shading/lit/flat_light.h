// Computes the irradiance of flat faces from punctual lights at their corners. It differs at edges where radiance
// jumps.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// Holds the faces and the viewer.
struct FlatFaces {
    const double* verts;
    const int32_t* faces;
    int64_t n_verts, n_faces;
    Vec3 eye;  // In an orthographic view it is the unit direction towards the eye.
    bool perspective;
};

struct PunctualLight {
    Vec3 place;  // At infinity, it is the unit direction towards the light.
    bool infinite;
    double power;  // W/sr, or W/m² at infinity

    // Returns the irradiance at normal incidence, divided by the distance |l|.
    double arriving_over_distance(Vec3 at) const {
        if (infinite) return power;
        const double squared = dot(place - at, place - at);
        return squared > 0 ? power / (squared * std::sqrt(squared)) : 0;
    }
};

// Below this cosine, the visible side of a face counts as unknown.
constexpr double edge_on = 1e-3;

// Returns (F, 3, L): E max(0, n·l) for the normal n on the viewer's side, divided by the largest of all. Two faces
// agree at both ends of an edge only if they agree along all of it. The reason is that n·l is the distance of the light
// from the face's plane, over |l|.
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
