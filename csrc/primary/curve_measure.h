// This file declares the sampling density of each curve, and what the boundary term knows of creases without a sample.
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

// Curves lie end to end by length · (mean |A| near them) · (estimated jump). The measure is reduced where they are most
// likely occluded, or where a control (crease_control.h) covers nearly all.
struct CurvesFound {
    double pixels = 0;                // measure without the adjoint, which sets the default number of samples
    double squares = 0, unknown = 0;  // Σ measure² of what is expected to be visible, and of what controls do not cover
    int64_t silhouettes = 0, creases = 0, intersections = 0;  // number in view
    double lens_boundary = 0;                                 // px of the lens boundary in view
};
struct MeasuredCurve {
    double measure = 0;
    int32_t edge;
    bool controlled = false;  // whether x_bar has the integral of a crease's control
    bool hidden = false;      // whether it is a crease between hidden faces (crease_faces.h)
};
// A ClearCrease is a crease between faces that are wholly visible.
struct ClearCrease {
    int32_t curve;
    CellMarks::Cells cells;
};
struct MeasuredIntersection {
    double measure = 0;
    int32_t index;  // index in Curves::lines()
};
// Returns an upper bound of the bytes per curve in view; the list of curves doubles as it grows.
constexpr int64_t bytes_per_curve() {
    return 3 * (sizeof(MeasuredCurve) + sizeof(ClearCrease)) + sizeof(double) + CoincidentCurves::bytes_per_curve();
}

template <class T>
struct Curves : CurvesFound {
    CurveFinder<T> finder;
    Array<MeasuredCurve> curve{0};  // curves where the adjoint is not zero, by ascending edges
    Array<Intersection> drawn{0};   // subset of the geometry's intersections, if this view draws its own
    std::vector<MeasuredIntersection> intersection;        // intersections of faces, numbered after the curves
    std::optional<LensBoundaryCurve> lens_boundary_curve;  // lens boundary, numbered last, if it is asked for
    Array<double> measure{0};                              // measure of all curves, in that order
    std::vector<std::vector<ImageSegment>> segments;       // segments of the curves that others may lie on
    std::vector<std::vector<ClearCrease>> clear;           // creases without a segment
    bool any_hidden = false;  // whether there are creases between hidden faces, which have no segment either
    Array<double> x_bar;  // (V, 2) contribution of controls to the cotangents of image positions; empty: no controls

    Curves(const BackwardView<T>& view, Array<int8_t> facing);

    const Array<Intersection>& lines(const Geometry& geometry) const {
        return geometry.intersections().are_drawn() ? drawn : geometry.intersections().all();
    }
    int64_t arcs() const { return lens_boundary_curve ? int64_t(lens_boundary_curve->arcs.size()) : 0; }

    // Returns the number of samples: the one in `o`, if not −1, or the default for an image of `spp` samples per pixel.
    int64_t wanted(const GradientOptions& o, int spp) const;

    // Adds the segments of clear creases that share pixels with another curve, if either has samples. `all` adds all.
    void add_segments(const BackwardView<T>& view, const Systematic& samples, bool all);
};

// Finds and measures all curves, and initialises x_bar with the integrals of the controls. `facing` (F,) is
// Camera::facing. `lens_boundary` tells whether the lens boundary counts, which moves with the lens parameters alone.
template <class T>
Curves<T> measure_curves(const BackwardView<T>& view, Array<int8_t> facing, bool lens_boundary);

}  // namespace edgegrad
