// What a gradient is taken of, with which samples, and what taking it did.
#pragma once

#include <cstdint>

#include "estimator/hit_buffers.h"
#include "film/film.h"
#include "rays/geometry.h"

namespace edgegrad {

struct GradientOptions {
    int64_t surface_samples = -1;  // in all; −1: the default (surface_measure.cpp)
    int64_t edge_samples = -1;     // in all; −1: the default (curve_measure.cpp)
    uint64_t seed = 0;
    bool interior_geometry = true;  // whether the colours vary over faces, so that moving them shows inside
    bool boundary = true;
    bool intrinsics =
        true;           // whether they may move; where boundary does count, the border of what a lens shows then does
    bool steps = true;  // whether what moves steps within faces counts
    double step_spacing = 1;  // px between the lines that find them
    bool lit = false;         // whether samples are shaded by lights, at several times the cost
    bool dry = false;         // only count the samples
    bool controls = true;  // whether integrals that are known serve as control variates; they are of one given adjoint
    int pixel_spp = 0;     // if not zero, all of the interior term from so many samples a pixel, for the benchmarks
};

// What a backward pass did, and the seconds that each part took.
struct BackwardProfile {
    int64_t surface_samples = 0, edge_samples = 0;
    int64_t surface_wanted = 0, edge_wanted = 0;              // default samples before the budget (budget.h)
    int64_t silhouettes = 0, creases = 0, intersections = 0;  // curves in view
    double lens_boundary = 0;                                 // px in view of that of a lens
    int64_t step_lines = 0;                                   // that look for steps within faces
    int64_t shadow_samples = 0;
    double view = 0;                 // vertices in camera coordinates, where the adjoint is not zero
    double measure = 0, curves = 0;  // triangles and curves laid end to end
    double surface[2] = {0, 0}, edge[2] = {0, 0}, step[2] = {0, 0};  // samples with their rays; adding what they found
    double world = 0;                                                // from camera coordinates to the user's arrays

    // Of another sub-camera of the camera.
    BackwardProfile& operator+=(const BackwardProfile& o);
};

// What a gradient is taken of.
template <class T>
struct BackwardInput {
    const SceneView<T>& scene;
    const Camera& camera;
    const Geometry& geometry;
    const ImageOptions& image;  // of the image that was made
    const T* adjoint;           // ∂loss/∂image (H, W, C); null for records, which are drawn before it is known
    HitBuffers<T> hits;         // of that image
    // (F,): faces that look as a texture says, which the scene's own colours need not; null: none.
    const uint8_t* detailed = nullptr;
    // (F,): faces that one sees through, so that they hide no curve; null: none.
    const uint8_t* transparent = nullptr;
    // (H, W), above zero: how much records are to look at each pixel, for want of an adjoint; null: the same
    // everywhere.
    const T* importance_map = nullptr;
};

// The geometry that the terms of a derivative need.
inline GeometryWanted geometry_for(bool interior, bool boundary) {
    return {.topology = boundary, .parts = interior || boundary, .intersections = boundary};
}

}  // namespace edgegrad
