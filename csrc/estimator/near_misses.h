// Rays that pass a point of the image by less than they err: what floats cannot place there, one of them meets, and
// double decides.
#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <span>

#include "estimator/view.h"

namespace edgegrad {

// Of the error of floats. Not at twice that alone, for what they look for may be narrower.
constexpr double passed_by[] = {2, 0.5, 1.0 / 8, 1.0 / 32};

// Calls found(face) for each face that they meet, and returns that of the ray at n itself; −1: none. `error` is the way
// across a border of faces that runs by, as long as floats may err.
template <class T, class Found>
int32_t each_near_miss(const BackwardView<T>& view, Vec2 n, Vec2 error, std::span<const int32_t> ignored, Found found) {
    constexpr int rays = 1 + int(std::size(passed_by));
    CameraRays cast(view.frame);
    cast.n_x[0] = n.x, cast.n_y[0] = n.y, cast.count = rays;
    for (int i = 1; i < rays; ++i) {
        const Vec2 miss = n + passed_by[i - 1] * error;
        cast.n_x[i] = miss.x, cast.n_y[i] = miss.y;
    }
    std::span<const int32_t> all[rays];
    std::fill(std::begin(all), std::end(all), ignored);
    cast.prepare();
    view.frame.cast(cast, all);
    for (int i = 1; i < rays; ++i)
        if (cast.face[i] >= 0) found(cast.face[i]);
    return cast.face[0];
}

}  // namespace edgegrad
