// This file casts rays that pass a point of the image within the error of single precision. One of them meets the face
// that floats misplace, and double precision decides.
#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <span>

#include "estimator/view.h"

namespace edgegrad {

// The rays pass at these multiples of the floats' error: the face may be narrower than the largest.
constexpr double passed_by[] = {2, 0.5, 1.0 / 8, 1.0 / 32};

// Calls found(face) for each face that these rays meet. Returns the face that the ray at n itself meets; −1: none.
// `error` points across the nearby border of faces, and is as long as the error of floats.
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
