// This file processes several faces of the scene at once. Arrays have one number per lane, to vectorise loops.
#pragma once

#include <cstdint>
#include <vector>

#include "core/math.h"
#include "estimator/occlusion.h"
#include "film/importance.h"

namespace edgegrad {

struct FaceLanes {
    static constexpr int size = 32;

    explicit FaceLanes(int channels)
        : C(channels), adjoint(7 * C * size, 0.0), color(2 * C * size, 0.0), T(3 * C * size, 0.0) {}

    // Inputs are the faces, all inside the view, with the image positions and depths of their corners.
    int count = 0;
    int64_t face[size];
    double x[3][size] = {}, y[3][size] = {}, z[3][size] = {};

    // bound() sets the members below. `wedge` is twice the signed area, px². `longest` is the longest side, px.
    // `depths` is the ratio of the largest to the smallest depth. The filter reaches the pixels i0 … i1 − 1, j0 … j1 −
    // 1 from the face's box. `inside` holds the pixels at the middles of the sides and of the face.
    double wedge[size], longest[size], depths[size];
    int32_t i0[size], i1[size], j0[size], j1[size], inside[2][4][size];
    void bound(int width, int height, double radius);

    // Inputs of the controls (control.h), where there is one. They are the adjoint at the corners and in the pixels
    // inside, (C, 7, lanes), and two corners' colours minus the first's, (C, 2, lanes).
    const int C;
    std::vector<double> adjoint, color;

    // integrate() sets the members below. `T` is divided by the area, (C, 3, lanes). `x_bar` and `y_bar` are the
    // cotangents of the corners' positions. The others sum absolute values over channels: of the adjoint at the
    // corners, of its differences from the first, and of the inner pixels' from the corners' mean.
    std::vector<double> T;
    double x_bar[3][size], y_bar[3][size], sum[size], change[size], apart[size];
    void integrate();
};

// HiddenFaces does the same for hidden faces, which need less.
struct HiddenFaces {
    static constexpr int size = FaceLanes::size;

    // Inputs are the faces, with the image positions of their corners.
    int64_t face[size];
    double x[3][size] = {}, y[3][size] = {};

    // bound() sets the members below. `wedge` is twice the signed area, px². `side` is the longer side of the box, px.
    // `extent` is area + side · 1 px. `facing` is the sign of `wedge`, or 0 unless it exceeds `rounding` times `side`.
    // `tile` is OcclusionHint::tile_of the first corner.
    double wedge[size], side[size], extent[size];
    int32_t facing[size], tile[size];
    void bound(const OcclusionHint& occlusion, double rounding);
};

}  // namespace edgegrad
