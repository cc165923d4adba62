// The two passes: the image, and the gradient of a loss of the image.
#pragma once

#include <cstdint>
#include <vector>

#include "camera.h"
#include "film.h"
#include "geometry.h"
#include "scene.h"

namespace edgegrad {

// Calls f.template operator()<N>() with N = C where code for a fixed number of channels is compiled, else with 0.
template <class F>
void dispatch_channels(int channels, F f) {
    switch (channels) {
        case 1:
            return f.template operator()<1>();
        case 3:
            return f.template operator()<3>();
        case 4:
            return f.template operator()<4>();
        default:
            return f.template operator()<0>();
    }
}

struct ForwardOptions {
    int spp;  // samples a pixel
    Filter filter;
    uint64_t seed;
    int threads;
};

// image (H, W, C) and coverage (H, W): the filtered share of each pixel where something is hit.
template <class T>
void render_forward(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                    const ForwardOptions& options, T* image, T* coverage);

struct BackwardOptions {
    int64_t surface_samples;  // in all; −1: one per unit of surface measure
    int64_t edge_samples;     // in all; −1: 16 a pixel of curve
    Filter filter;
    uint64_t seed;
    int threads;
    bool interior_geometry;  // whether the colours vary over faces, so that moving them shows inside
    bool boundary;
    double spacing;  // relative spacing of the numbers in which the user gave the vertices
};

// What a backward pass did.
struct BackwardCounts {
    int64_t surface_samples = 0, edge_samples = 0;
};

// q = R p + t, backwards: p̄ = Rᵀ q̄, R̄ = Σ q̄ pᵀ, t̄ = Σ q̄, for q_bar (V, 3).
void add_world(const Camera& camera, const double* verts, const std::vector<double>& q_bar, int threads,
               const SceneGrad& grad);

// Adds the gradient to what `grad` points to, given the adjoint image ∂loss/∂I (H, W, C).
template <class T>
BackwardCounts render_backward(const SceneView<T>& scene, const Camera& camera, const Geometry& geometry,
                               const BackwardOptions& options, const T* adjoint, const T* coverage,
                               const SceneGrad& grad);

// Radiance (N, C) at pixel positions (N, 2) on the given faces, and its derivative; for the tests.
template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance);
template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const SceneGrad& grad);

}  // namespace edgegrad
