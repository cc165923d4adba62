// Declares the terms of a derivative of the image, and estimates them for one sub-camera.
#pragma once

#include "accumulate/accumulation.h"
#include "accumulate/gradients.h"
#include "estimator/budget.h"
#include "estimator/gradient_input.h"
#include "estimator/view.h"

namespace edgegrad {

// Terms tells which terms are wanted.
struct Terms {
    bool motion;      // interior term of motion
    bool appearance;  // interior term of colours and textures
    bool boundary;
    bool lens_boundary;    // lens boundary, in addition to other curves
    bool discontinuities;  // discontinuities within faces

    bool interior() const { return motion || appearance; }
    bool any() const { return interior() || boundary || discontinuities; }
};

template <class Number>
Terms terms_of(const Slots<Number>& slots, const GradientOptions& o) {
    const bool moves = slots.geometry();
    return {.motion = moves && o.interior_geometry,
            .appearance = slots.appearance(),
            .boundary = moves && o.boundary,
            .lens_boundary = (slots.K || slots.distortion) && o.boundary && o.intrinsics,
            .discontinuities = slots.discontinuities() && o.discontinuities};
}

// Returns the terms of everything that may move.
inline Terms all_motion(const GradientOptions& o) {
    return {.motion = o.interior_geometry,
            .appearance = false,
            .boundary = o.boundary,
            .lens_boundary = o.boundary && o.intrinsics,
            .discontinuities = o.discontinuities};
}

// Returns how many samples the terms want by default.
template <class T>
SampleCounts wanted_samples(const BackwardView<T>& view, const Terms& terms);

// Limits the samples to the budget of the image, except numbers that the user sets.
template <class T>
SampleCounts within_budget(const BackwardInput<T>& input, const GradientOptions& o, SampleCounts wanted,
                           ThreadTeam& team);

// Measures what the terms sample, draws the samples and accumulates them.
template <class T>
void add_terms(const BackwardInput<T>& input, const BackwardView<T>& view, const Terms& terms,
               const Accumulation& accumulation, GradientSink& to, BackwardProfile& profile);

}  // namespace edgegrad
