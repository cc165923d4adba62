// The gradient of a loss of the image.
#pragma once

#include <cstdint>
#include <vector>

#include "contract/record.h"
#include "forward/forward.h"
#include "scene/geometry.h"
#include "scene/gradients.h"
#include "scene/light_parts.h"

namespace edgegrad {

struct LitPaths;  // boundary/bounces.h
struct BounceSamples;
struct MovingBorders;

struct GradientOptions {
    int64_t surface_samples = -1;  // in all; −1: the default (surface_measure.cpp)
    int64_t edge_samples = -1;     // in all; −1: the default (curve_measure.cpp)
    uint64_t seed = 0;
    bool interior_geometry = true;  // whether the colours vary over faces, so that moving them shows inside
    bool boundary = true;
    bool intrinsics = true;  // whether they may move; where boundary does count, the rim of what a lens shows then does
    bool steps = true;       // whether what moves steps within faces counts
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
    double rim = 0;                                           // px in view of that of a lens
    int64_t step_lines = 0;                                   // that look for steps within faces
    int64_t shadow_samples = 0;
    double view = 0;                 // vertices in camera coordinates, where the loss looks
    double measure = 0, curves = 0;  // triangles and curves laid end to end
    double surface[2] = {0, 0}, edge[2] = {0, 0}, step[2] = {0, 0};  // samples with their rays; adding what they found
    double world = 0;                                                // from camera coordinates to the user's arrays

    // Of another window of the camera.
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
    const uint8_t* panes = nullptr;
    // (H, W), above zero: how much records are to look at each pixel, for want of an adjoint; null: the same
    // everywhere.
    const T* looks = nullptr;
};

// The geometry that the terms of a derivative need.
inline GeometryWanted geometry_for(bool interior, bool boundary) {
    return {.topology = boundary, .parts = interior || boundary, .intersections = boundary};
}

// Adds the gradient to what `grad` points to.
template <class T>
BackwardProfile render_backward(const BackwardInput<T>& input, const GradientOptions& options, Team& team,
                                const Gradients& grad);

// Derivatives of the image in several directions, forward mode: adds to `image_dot` (H, W, D, C). `adjoint` says how
// much each pixel matters for where samples go; ones, if all do.
template <class T>
void render_tangents(const BackwardInput<T>& input, GradientOptions options, Team& team,
                     const std::vector<Tangents>& tangents, double* image_dot);

// The gradient by places in the image: adds to `gradient` (H, W, 2) how the loss changes as what is seen in a pixel
// moves right and down, per pixel that it moves.
template <class T>
void render_screen_gradient(const BackwardInput<T>& input, GradientOptions options, Team& team, double* gradient);

// The samples of both terms, for shaders written in PyTorch. Creases are the edges at which the scene's colours jump.
template <class T>
RecordList record_samples(const BackwardInput<T>& input, GradientOptions options, Team& team);

// The samples on the borders of the shadows of `casters`, the scene as light meets it; so many or, if −1, by default.
template <class T>
std::vector<CurveRecords> record_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                         const GradientOptions& options, const LightParts& light, int64_t samples,
                                         Team& team);
// So many on those that lie on surfaces, seen or not (boundary/unseen_shadows.h).
template <class T>
std::vector<CurveRecords> record_unseen_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                const GradientOptions& options, const LightParts& light,
                                                int64_t samples, Team& team);

// The samples on the borders of what surfaces of paths of light see of one another (boundary/bounces.h).
template <class T>
std::vector<CurveRecords> record_bounces(const BackwardInput<T>& input, const SceneView<T>& casters,
                                         const GradientOptions& options, const LitPaths& paths, int64_t samples,
                                         Team& team, BounceSamples& out);
// Those on curves at which surfaces begin to send light (boundary/surface_borders.h).
template <class T>
std::vector<CurveRecords> record_surface_borders(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                 const GradientOptions& options, const LitPaths& paths,
                                                 MovingBorders moving, int64_t samples, Team& team, BounceSamples& out);

// q = T (R p + t), backwards: p̄ = (T R)ᵀ q̄, R̄ = Tᵀ Σ q̄ pᵀ, t̄ = Tᵀ Σ q̄, for q_bar (V, 3), with the turn T of a window.
void add_world(const Camera& window, const double* verts, const Array<double>& q_bar, Team& team,
               const Gradients& grad);

}  // namespace edgegrad
