// Points of lights, from which edges cast shadows. A light that has an extent is given by many points, drawn at random
// with a density that its radiance is divided by elsewhere: what they cast counts as the mean of them.
#pragma once

#include <cstdint>

#include "core/math.h"

namespace edgegrad {

struct LightPoints {
    const double* place;      // (L, 3) world coordinates, or, at infinity, the direction towards the light
    const uint8_t* infinite;  // (L,)
    const double* power;      // (L,) ≥ 0: radiance of what it lights at the distance one, or at infinity; relative
    const int32_t* face;      // (L,) that the point lies on, −1: none
    const int64_t* first;     // (lights + 1,) of the points of each light
    int64_t lights = 0;

    int64_t size() const { return lights ? first[lights] : 0; }
    Vec3 at(int64_t i) const { return {place[3 * i], place[3 * i + 1], place[3 * i + 2]}; }
};

}  // namespace edgegrad
