// Prepares what all terms share for each sub-camera.
#pragma once

#include <functional>
#include <type_traits>

#include "backward/terms.h"
#include "estimator/gradient_input.h"
#include "estimator/view.h"

namespace edgegrad {

template <class T>
using ViewBody = std::function<void(const BackwardView<T>&)>;

// Calls body(view) for each sub-camera of the camera.
template <class T>
void each_view(const BackwardInput<T>& input, const GradientOptions& options, const Terms& terms, ThreadTeam& team,
               const std::type_identity_t<ViewBody<T>>& body);

// Calls body(view) for one sub-camera, where the result does not depend on which.
template <class T>
void with_any_sub_camera(const BackwardInput<T>& input, const GradientOptions& options, ThreadTeam& team,
                         const std::type_identity_t<ViewBody<T>>& body);

}  // namespace edgegrad
