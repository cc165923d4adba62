// How densely each curve is sampled, and what the boundary term knows of creases without a sample.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "boundary/curve.h"
#include "estimator/view.h"
#include "primary/cell_marks.h"
#include "primary/coincident_segments.h"
#include "primary/lens_boundary_source.h"

namespace edgegrad {

// Curves are laid end to end by length · (mean |Ã| near them) · (how large the jump is, as far as it is known), less
// where they are most likely occluded or where a control (crease_control.h) says nearly all.
struct CurvesFound {
    double pixels = 0;                // the measure without the adjoint, which default samples go by
    double squares = 0, unknown = 0;  // Σ measure² of what is expected to be visible, and of what controls do not say
    int64_t silhouettes = 0, creases = 0, intersections = 0;  // in view
    double lens_boundary = 0;                                 // px of the lens boundary, in view
};
struct MeasuredCurve {
    double measure = 0;
    int32_t edge;
    bool controlled = false;  // whether x_bar has the integral of a crease's control
    bool hidden = false;      // a crease between hidden faces (crease_faces.h)
};
// A crease between faces that are seen whole.
struct ClearCrease {
    int32_t curve;
    CellMarks::Cells cells;
};
struct MeasuredIntersection {
    double measure = 0;
    int32_t index;  // of Curves::lines()
};
// Bytes of a curve in view, at most; the list of curves doubles as it grows.
constexpr int64_t bytes_per_curve() {
    return 3 * (sizeof(MeasuredCurve) + sizeof(ClearCrease)) + sizeof(double) + CoincidentCurves::bytes_per_curve();
}

template <class T>
struct Curves : CurvesFound {
    CurveFinder<T> finder;
    Array<MeasuredCurve> curve{0};                         // those where the adjoint is not zero, by ascending edges
    Array<Intersection> drawn{0};                          // of those of the geometry, if this view draws its own
    std::vector<MeasuredIntersection> intersection;        // after them, those of faces that pass through each other
    std::optional<LensBoundaryCurve> lens_boundary_curve;  // and after these the lens boundary, if it is asked for
    Array<double> measure{0};                              // of all
    std::vector<std::vector<ImageSegment>> segments;       // of those that others may lie on
    std::vector<std::vector<ClearCrease>> clear;           // of which no segment was made
    bool any_hidden = false;                               // or of creases between hidden faces, if there are any
    Array<double> x_bar;  // (V, 2) what controls add to the cotangents of places in the image; empty: there are none

    Curves(const BackwardView<T>& view, Array<int8_t> facing);

    const Array<Intersection>& lines(const Geometry& geometry) const {
        return geometry.intersections().are_drawn() ? drawn : geometry.intersections().all();
    }
    int64_t arcs() const { return lens_boundary_curve ? int64_t(lens_boundary_curve->arcs.size()) : 0; }

    // Samples: so many as are given, if not −1, or the defaults.
    int64_t wanted(const GradientOptions& o) const;

    // Adds the segments of those clear creases in whose pixels any other curve lies, where either has samples; or of
    // all creases.
    void add_segments(const BackwardView<T>& view, const Systematic& samples, bool all);
};

// Finds and measures all curves, and begins x_bar with the integrals of the controls. `facing` (F,): Camera::facing.
// `boundary`: whether that of a lens counts, which moves with its parameters alone.
template <class T>
Curves<T> measure_curves(const BackwardView<T>& view, Array<int8_t> facing, bool lens_boundary);

}  // namespace edgegrad
