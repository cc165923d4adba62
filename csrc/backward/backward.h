// This file declares the gradient of a loss of the image, and the recorders of its samples.
#pragma once

#include <cstdint>
#include <vector>

#include "accumulate/gradients.h"
#include "accumulate/records.h"
#include "estimator/gradient_input.h"
#include "scene/light_parts.h"

namespace edgegrad {

struct LitPaths;  // secondary/secondary_edges.h
struct SecondaryEdgeSamples;
struct MovingEdges;

// Adds the gradient to the arrays of `grad`.
template <class T>
BackwardProfile render_backward(const BackwardInput<T>& input, const GradientOptions& options, ThreadTeam& team,
                                const Gradients& grad);

// Adds derivatives of the image in several directions, forward mode, to `image_dot` (H, W, D, C). `adjoint` is the
// importance of each pixel for the placement of samples; ones, if all count equally.
template <class T>
void render_tangents(const BackwardInput<T>& input, GradientOptions options, ThreadTeam& team,
                     const std::vector<Tangents>& tangents, double* image_dot);

// Adds the screen-space gradient to `gradient` (H, W, 2): loss change per px that a pixel's content moves right, down.
template <class T>
void render_screen_gradient(const BackwardInput<T>& input, GradientOptions options, ThreadTeam& team, double* gradient);

// Returns the samples of both terms, for PyTorch shaders. Creases are edges at which the scene's colours jump.
template <class T>
RecordList record_samples(const BackwardInput<T>& input, GradientOptions options, ThreadTeam& team);

// Returns samples on shadow boundaries. `casters` is the scene as light meets it. `samples` = −1 is the default.
template <class T>
std::vector<CurveRecords> record_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                         const GradientOptions& options, const LightParts& light, int64_t samples,
                                         ThreadTeam& team);
// Returns `samples` samples on indirect shadow boundaries (secondary/indirect_shadows.h).
template <class T>
std::vector<CurveRecords> record_indirect_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                  const GradientOptions& options, const LightParts& light,
                                                  int64_t samples, ThreadTeam& team);

// Returns the samples on secondary edges (secondary/secondary_edges.h).
template <class T>
std::vector<CurveRecords> record_secondary_edges(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                 const GradientOptions& options, const LitPaths& paths, int64_t samples,
                                                 ThreadTeam& team, SecondaryEdgeSamples& out);
// Returns the samples on curves at which the light that surfaces send jumps (secondary/surface_edges.h).
template <class T>
std::vector<CurveRecords> record_surface_edges(const BackwardInput<T>& input, const SceneView<T>& casters,
                                               const GradientOptions& options, const LitPaths& paths,
                                               MovingEdges moving, int64_t samples, ThreadTeam& team,
                                               SecondaryEdgeSamples& out);

// Adds the adjoint of q = T (R p + t), with the rotation T of a sub-camera: p̄ = (T R)ᵀ q̄, R̄ = Tᵀ Σ q̄ pᵀ, t̄ = Tᵀ Σ
// q̄, for q_bar (V, 3).
void add_world(const Camera& sub_camera, const double* verts, const Array<double>& q_bar, ThreadTeam& team,
               const Gradients& grad);

}  // namespace edgegrad
