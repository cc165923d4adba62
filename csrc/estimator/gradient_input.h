// This file declares the input of a gradient: what is differentiated, the samples, and a profile of the pass.
#pragma once

#include <cstdint>

#include "estimator/hit_buffers.h"
#include "film/film.h"
#include "rays/geometry.h"

namespace edgegrad {

struct GradientOptions {
    int64_t surface_samples = -1;  // total; −1: the default (surface_measure.cpp)
    int64_t edge_samples = -1;     // total; −1: the default (curve_measure.cpp)
    uint64_t seed = 0;
    bool interior_geometry = true;  // whether colours vary over faces, so that motion shows inside them
    bool boundary = true;
    bool intrinsics = true;       // whether intrinsics may move; with `boundary`, the lens boundary then moves, too
    bool discontinuities = true;  // whether discontinuities within faces move
    double discontinuity_spacing = 1;  // px between the lines that find them
    bool lit = false;                  // whether lights shade the samples, at several times the cost
    bool indirect = false;             // whether light also comes to them by other surfaces
    bool dry = false;                  // whether to count the samples only
    bool controls = true;              // whether known integrals serve as control variates, which depend on the adjoint
    int pixel_spp = 0;  // if not zero, the interior term uses this number of samples per pixel only, for benchmarks
};

// BackwardProfile holds counts of a backward pass, and the seconds of each part.
struct BackwardProfile {
    int64_t surface_samples = 0, edge_samples = 0;
    int64_t surface_wanted = 0, edge_wanted = 0;              // default samples before the budget (budget.h)
    int64_t silhouettes = 0, creases = 0, intersections = 0;  // number of curves in view
    double lens_boundary = 0;                                 // px of the lens boundary in view
    int64_t discontinuity_lines = 0;                          // number of lines that find discontinuities within faces
    double view = 0;                                          // time for vertices in camera coordinates
    double measure = 0, curves = 0;                           // time to lay triangles and curves end to end
    double surface[2] = {0, 0}, edge[2] = {0, 0},
           discontinuity[2] = {0, 0};  // time for samples with their rays; time to add the results
    double world = 0;                  // time from camera coordinates to the user's arrays

    // Adds the profile of another sub-camera.
    BackwardProfile& operator+=(const BackwardProfile& o);
};

// BackwardInput holds what a gradient is taken of.
template <class T>
struct BackwardInput {
    const SceneView<T>& scene;
    const Camera& camera;
    const Geometry& geometry;
    const ImageOptions& image;  // options of the forward image
    const T* adjoint;           // ∂loss/∂image (H, W, C); null for records, which are drawn before it is known
    HitBuffers<T> hits;         // hits of the forward image
    // (F,): faces whose appearance comes from a texture, even if the scene's own colours do not show it; null: none.
    const uint8_t* detailed = nullptr;
    // (F,): transparent faces, which occlude no curve; null: none.
    const uint8_t* transparent = nullptr;
    // (H, W), above zero: importance of each pixel to records, for want of an adjoint; null: uniform.
    const T* importance_map = nullptr;
};

// Returns the geometry that the terms of a derivative need.
inline GeometryWanted geometry_for(bool interior, bool boundary) {
    return {.topology = boundary, .parts = interior || boundary, .intersections = boundary};
}

}  // namespace edgegrad
