// How densely each curve is sampled, and what the boundary term knows of creases without a sample.
#pragma once

#include <cstdint>
#include <vector>

#include "backward/view.h"
#include "boundary/coincident.h"
#include "boundary/curve.h"

namespace edgegrad {

// Curves are laid end to end by length · (mean |Ã| near them) · (how large the jump is, as far as it is known), less
// where they are most likely occluded or where a control (crease_control.h) says nearly all.
struct CurvesFound {
    double pixels = 0;  // the measure without the adjoint, which default samples go by
    int64_t silhouettes = 0, creases = 0, intersections = 0;  // in view
};
struct MeasuredCurve {
    double measure = 0;
    int32_t edge;
    bool controlled = false;  // whether x_bar has the integral of a crease's control
};
struct MeasuredIntersection {
    double measure = 0;
    int32_t index;  // of Intersections
};
// Bytes of a curve in view, at most; the list of curves doubles as it grows.
constexpr int64_t bytes_per_curve() {
    return 3 * sizeof(MeasuredCurve) + sizeof(double) + CoincidentCurves::bytes_per_curve();
}

template <class T>
struct Curves : CurvesFound {
    CurveFinder<T> finder;
    std::vector<MeasuredCurve> curve;                 // those where the loss looks, by ascending edges
    std::vector<MeasuredIntersection> intersection;   // after them, those of faces that pass through each other
    Array<double> measure{0};                         // of both
    std::vector<std::vector<ImageSegment>> segments;  // of those that others may lie on, by ascending edges
    Array<double> x_bar;  // (V, 2) what controls add to the cotangents of places in the image; empty: there are none

    Curves(const BackwardView<T>& view, Array<int8_t> facing);

    // Samples: so many as are given, if not −1, or the defaults.
    int64_t wanted(int64_t given) const;
};

// Finds and measures all curves, and begins x_bar with the integrals of the controls. `facing` (F,): Camera::facing.
template <int N, class T>
Curves<T> measure_curves(const BackwardView<T>& view, Array<int8_t> facing);

}  // namespace edgegrad
