// Measures where the contour lies on lines across it, and adds these distances to a pose's system.
#pragma once

#include <span>
#include <vector>

#include "track/edge.h"
#include "track/normal_equations.h"
#include "track/region.h"

namespace edgegrad {

// Holds the mean and the variance of a line's p(d), px along the normal.
struct LineDistance {
    float mean = 0, variance = 1;
    float gain = -1;  // how much likelier a contour is than none, nats; -1 where colours are unknown
    float share = 1;  // probability that the contour is where mean and variance are of; else something else ends there

    bool shows_edge() const { return gain > 0.5f; }
    bool is_close() const { return shows_edge() && share > 0.5f && mean < 1.5f && mean > -1.5f; }
};

// Says how to measure lines.
struct LineScale {
    int segment;             // px
    bool exact;              // whether the pixels across the contour count as well
    double gate;             // px from the pose within which the contour is expected, unless the pixels count
    const double* velocity;  // (6,) step of a frame, by which lines may be blurred
};

class LineTerm {
   public:
    LineTerm() { points_.reserve(2 * TrackSettings::candidates), distances_.reserve(2 * TrackSettings::candidates); }

    // Measures points of a contour at a pose, in place of those before.
    void measure(const Frame& frame, ColorHistograms& histograms, const TrackCamera& camera, const PosedMesh& object,
                 std::span<const ContourPoint> points, const LineScale& scale);
    // Does the same on sharp edges within the outline, where the pixels across an edge count alone.
    void measure_sharp(const Frame& frame, std::span<const ContourPoint> points);
    // Adds the measured distances at a pose, whose points may have moved since. Residuals have Cauchy's distribution
    // about the normal one of p(d), with this scale, px.
    void add(const TrackCamera& camera, const PosedMesh& object, double cauchy, NormalEquations& to) const;

    // Returns the root of the mean of squared residuals at a pose, in their standard deviations, of lines that show an
    // edge.
    double residual(const TrackCamera& camera, const PosedMesh& object) const;

    // Holds the models of the colour inside, and learns their probabilities from the lines of the contour.
    SideModels models;
    void learn_models();

    // Returns the distances of the points of the contour, without those on sharp edges.
    std::span<const LineDistance> distances() const { return std::span(distances_).first(outline_); }

    // Returns the mean and variance of the product of both likelihoods, or within the gate where `edge` is null.
    static LineDistance combine(const RegionEvidence& region, int segment, double gate, const float* edge);

   private:
    RegionModel region_;
    EdgeModel edge_;
    std::vector<ContourPoint> points_;
    std::vector<LineDistance> distances_;
    double shares_[SideModels::count] = {};
    size_t outline_ = 0;
};

}  // namespace edgegrad
