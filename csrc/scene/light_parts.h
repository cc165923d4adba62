// Describes a light for edge sampling: a point, or triangles that are sampled uniformly.
//
// The light's own pdf of points is p; `chance` is ∫ p over a part. Σ chance · (mean over the part's area) is thus the
// mean over points sampled with p. The radiance of a sample, divided by p, is meant for this mean.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"

namespace edgegrad {

struct LightParts {
    // (L, 3, 3) holds world coordinates, or directions towards a light at infinity; a point is given three times.
    const double* corner;
    const double* chance;  // (L,) > 0
    const int32_t* face;   // (L,) the part's face in the scene, −1: none
    int64_t count = 0;
    bool infinite = false, extended = false, two_sided = true;

    Vec3 at(int64_t part, int i) const {
        const double* c = corner + 9 * part + 3 * i;
        return {c[0], c[1], c[2]};
    }
    // Returns the point at the last two barycentrics, or the unit direction at infinity.
    Vec3 at(int64_t part, Vec2 uv) const {
        const Vec3 p = (1 - uv.x - uv.y) * at(part, 0) + uv.x * at(part, 1) + uv.y * at(part, 2);
        return infinite ? (1 / length(p)) * p : p;
    }
    // Returns the weight of light that leaves a point for another, for pdfs only: L cos θ / r² over L. Behind a face,
    // it keeps a small part of 1 / r², for shaders that see shadows there, too.
    double towards(int64_t part, Vec3 from, Vec3 to) const {
        if (infinite) return 1;
        const Vec3 d = to - from;
        const double squared = dot(d, d);
        if (!extended) return 1 / squared;
        const Vec3 n = cross(at(part, 1) - at(part, 0), at(part, 2) - at(part, 0));
        const double cosine = dot(n, d) / (length(n) * std::sqrt(squared));
        constexpr double least = 0.02;
        return (least + (two_sided ? std::fabs(cosine) : std::max(cosine, 0.0))) / squared;
    }
};

}  // namespace edgegrad
