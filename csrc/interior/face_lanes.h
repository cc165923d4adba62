// Faces side by side: what is done for each face of the scene, done for several at once. Arrays have one number a
// lane, so that loops over lanes become vectors.
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

    // Given: the faces, all inside the view; the places of their corners in the image, and their depths.
    int count = 0;
    int64_t face[size];
    double x[3][size] = {}, y[3][size] = {}, z[3][size] = {};

    // By bound(): twice the signed area, px²; the longest side, px; the greatest depth over the least; the pixels
    // i0 … i1 − 1, j0 … j1 − 1 that a filter of this radius reaches from the box of the face; and x and y of the pixels
    // at the middles of the sides and of the face.
    double wedge[size], longest[size], depths[size];
    int32_t i0[size], i1[size], j0[size], j1[size], inside[2][4][size];
    void bound(int width, int height, double radius);

    // Given for the controls (control.h), as far as there is one: the adjoint at the corners and in the pixels inside,
    // (C, 7, lanes), and the colours of two corners less that of the first, (C, 2, lanes).
    const int C;
    std::vector<double> adjoint, color;

    // By integrate(): T over the area, (C, 3, lanes); the cotangents of the places of the corners; and over all
    // channels the sizes of the adjoint at the corners, its differences from the first, and those of the pixels inside
    // from the mean of the corners.
    std::vector<double> T;
    double x_bar[3][size], y_bar[3][size], sum[size], change[size], apart[size];
    void integrate();
};

// The same for faces of which little is asked, for they are hidden.
struct HiddenFaces {
    static constexpr int size = FaceLanes::size;

    // Given: the faces, and the places of their corners in the image.
    int64_t face[size];
    double x[3][size] = {}, y[3][size] = {};

    // By bound(): twice the signed area, px²; the longer side of the box, px; area + side · 1 px; the sign of the
    // first, 0 unless it is larger than `rounding` times the second; OcclusionHint::tile_of the first corner.
    double wedge[size], side[size], extent[size];
    int32_t facing[size], tile[size];
    void bound(const OcclusionHint& occlusion, double rounding);
};

}  // namespace edgegrad
