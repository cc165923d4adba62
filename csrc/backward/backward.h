// The gradient of a loss of the image.
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

// Adds the gradient to what `grad` points to.
template <class T>
BackwardProfile render_backward(const BackwardInput<T>& input, const GradientOptions& options, ThreadTeam& team,
                                const Gradients& grad);

// Derivatives of the image in several directions, forward mode: adds to `image_dot` (H, W, D, C). `adjoint` says how
// much each pixel matters for where samples go; ones, if all do.
template <class T>
void render_tangents(const BackwardInput<T>& input, GradientOptions options, ThreadTeam& team,
                     const std::vector<Tangents>& tangents, double* image_dot);

// The gradient by places in the image: adds to `gradient` (H, W, 2) how the loss changes as what is seen in a pixel
// moves right and down, per pixel that it moves.
template <class T>
void render_screen_gradient(const BackwardInput<T>& input, GradientOptions options, ThreadTeam& team, double* gradient);

// The samples of both terms, for shaders written in PyTorch. Creases are the edges at which the scene's colours jump.
template <class T>
RecordList record_samples(const BackwardInput<T>& input, GradientOptions options, ThreadTeam& team);

// The samples on the borders of the shadows of `casters`, the scene as light meets it; so many or, if −1, by default.
template <class T>
std::vector<CurveRecords> record_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                         const GradientOptions& options, const LightParts& light, int64_t samples,
                                         ThreadTeam& team);
// So many on those that lie on surfaces, seen or not (secondary/indirect_shadows.h).
template <class T>
std::vector<CurveRecords> record_indirect_shadows(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                  const GradientOptions& options, const LightParts& light,
                                                  int64_t samples, ThreadTeam& team);

// The samples on the borders of what surfaces of paths of light see of one another (secondary/secondary_edges.h).
template <class T>
std::vector<CurveRecords> record_secondary_edges(const BackwardInput<T>& input, const SceneView<T>& casters,
                                                 const GradientOptions& options, const LitPaths& paths, int64_t samples,
                                                 ThreadTeam& team, SecondaryEdgeSamples& out);
// Those on curves at which surfaces begin to send light (secondary/surface_edges.h).
template <class T>
std::vector<CurveRecords> record_surface_edges(const BackwardInput<T>& input, const SceneView<T>& casters,
                                               const GradientOptions& options, const LitPaths& paths,
                                               MovingEdges moving, int64_t samples, ThreadTeam& team,
                                               SecondaryEdgeSamples& out);

// q = T (R p + t), backwards: p̄ = (T R)ᵀ q̄, R̄ = Tᵀ Σ q̄ pᵀ, t̄ = Tᵀ Σ q̄, for q_bar (V, 3), with the turn T of a
// sub-camera.
void add_world(const Camera& sub_camera, const double* verts, const Array<double>& q_bar, ThreadTeam& team,
               const Gradients& grad);

}  // namespace edgegrad
