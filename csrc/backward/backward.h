// This file declares the gradient of a loss of the image, and the recorders of its samples.
#pragma once

#include <functional>
#include <type_traits>
#include <vector>

#include "accumulate/gradients.h"
#include "accumulate/records.h"
#include "estimator/gradient_input.h"
#include "estimator/view.h"

namespace edgegrad {

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

// Returns the samples that record(view, sink) adds, such as those on shadow boundaries (secondary/shadows.h): for each
// sub-camera, or for any one, unless the camera must see the samples.
template <class T>
using RecordBody = std::function<void(const BackwardView<T>&, GradientSink&)>;
template <class T>
std::vector<CurveRecords> record_curves(const BackwardInput<T>& input, const GradientOptions& options, bool seen,
                                        ThreadTeam& team, const std::type_identity_t<RecordBody<T>>& record);

}  // namespace edgegrad
