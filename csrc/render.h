// The two passes: the image, and the gradient of a loss of the image.
#pragma once

#include <cstdint>
#include <vector>

#include "camera.h"
#include "film.h"
#include "geometry.h"
#include "sampler.h"
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

// Of those numbers, for explicit instantiations.
#define EDGEGRAD_FOR_CHANNELS(X) X(0) X(1) X(3) X(4)

struct ForwardOptions {
    int spp;  // samples a pixel
    Filter filter;
    uint64_t seed;
};

// Of points of the unit square, in place: where rays through pixel (x, y) go, drawn in proportion to the filter.
void place_in_pixel(const Camera& camera, const Filter& filter, int x, int y, int n, double* n_x, double* n_y);

// The rays of the forward pass: samples first … first + n − 1 of pixel (x, y), appended to a batch.
class PixelRays {
   public:
    PixelRays(const Camera& camera, const ForwardOptions& o)
        : camera_(camera), filter_(o.filter), seed_(o.seed), lattice_(o.spp) {}

    void append(int x, int y, int first, int n, RayBatch& rays) const;

   private:
    const Camera& camera_;
    Filter filter_;
    uint64_t seed_;
    ShiftedLattice lattice_;
};

// Where the forward pass writes.
template <class T>
struct ForwardOutput {
    T* image;       // (H, W, C)
    T* coverage;    // (H, W): the filtered share of each pixel where something is hit
    float* depth;   // (H, W): nothing that samples hit lies farther away; infinite where one hit nothing
    int32_t* hit;   // (H, W, 2): the first and the last of the faces that were hit, as the scene counts them; −1: none
    uint8_t* seen;  // (F,): 0, or the side, 1 or 2, from which a sample hit the face
};

template <class T>
void render_forward(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                    const ForwardOptions& options, Team& team, const ForwardOutput<T>& out);

// Seconds that the rays of the forward pass take when they are cast and nothing else is done; for the benchmarks.
double bare_loop(const Camera& camera, const RayCaster& caster, const ForwardOptions& options, int packet_width,
                 Team& team);

struct BackwardOptions {
    int spp;                  // of the image that was made
    int64_t surface_samples;  // in all; −1: the default (surface_measure.cpp)
    int64_t edge_samples;     // in all; −1: the default (boundary.cpp)
    Filter filter;
    uint64_t seed;
    bool interior_geometry;  // whether the colours vary over faces, so that moving them shows inside
    bool boundary;
    Spacing spacing;
    bool dry;           // only count the samples
    int pixel_spp = 0;  // if not zero, all of the interior term from so many samples a pixel, for the benchmarks
};

// What a backward pass did, and the seconds that each part took.
struct BackwardProfile {
    int64_t surface_samples = 0, edge_samples = 0;
    int64_t surface_wanted = 0, edge_wanted = 0;   // default samples before the budget (budget.h)
    int64_t silhouettes = 0, creases = 0;          // curves in view
    double view = 0;                               // vertices in camera coordinates, where the loss looks
    double measure = 0, curves = 0;                // triangles and curves laid end to end
    double surface[2] = {0, 0}, edge[2] = {0, 0};  // samples with their rays; adding what they found
    double world = 0;                              // from camera coordinates to the user's arrays
};

// What the backward pass takes from the forward pass; see ForwardOutput.
template <class T>
struct ForwardView {
    const T* coverage = nullptr;
    const float* depth = nullptr;
    const int32_t* hit = nullptr;
    const uint8_t* seen = nullptr;
};

// q = R p + t, backwards: p̄ = Rᵀ q̄, R̄ = Σ q̄ pᵀ, t̄ = Σ q̄, for q_bar (V, 3).
void add_world(const Camera& camera, const double* verts, const Array<double>& q_bar, Team& team,
               const SceneGrad& grad);

// Adds the gradient to what `grad` points to, given the adjoint image ∂loss/∂I (H, W, C).
template <class T>
BackwardProfile render_backward(const SceneView<T>& scene, const Camera& camera, const Geometry& geometry,
                                const BackwardOptions& options, Team& team, const T* adjoint,
                                const ForwardView<T>& forward, const SceneGrad& grad);

// Radiance (N, C) at pixel positions (N, 2) on the given faces, and its derivative; for the tests.
template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance);
template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const SceneGrad& grad);

}  // namespace edgegrad
