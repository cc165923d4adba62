// Computes the likelihood of a contour's position on a line from colours (Stoiber et al., SRT3D, IJCV 2022). With the
// segments r of a line and the contour's distance d, both in segments,
//
//     p(d) ~ prod_r [ h(r - d) p_f(r) + (1 - h(r - d)) p_b(r) ],   h(x) = 1/2 - a tanh(x / 2 s),
//
// where p_f and p_b are the posteriors of a segment's colours for inside and outside. The noise is that of SRT3D: a
// segment has the wrong colours with the probability 1/2 - a, independently of its neighbours.
#pragma once

#include "track/contour.h"
#include "track/frame.h"
#include "track/histograms.h"

namespace edgegrad {

// Holds log p(d) for d = -reach ... reach segments.
struct RegionEvidence {
    static constexpr int distances = 2 * TrackSettings::reach + 1;

    float log[distances];
    // Logarithm of the mean of p(d), relative to that of a line without a contour, all of it inside or all of it
    // outside.
    float gain;
    bool known;  // whether most of its colours are those of either side
};

class RegionModel {
   public:
    RegionModel();

    // Evaluates a line whose segments are `scale` px long.
    RegionEvidence evaluate(const Frame& frame, ColorHistograms& histograms, const ContourPoint& point,
                            int scale) const;

    // Returns log p(d) from the probabilities (segments,) that each segment is inside.
    RegionEvidence evaluate(const float* inside) const;

    static constexpr int segments = RegionEvidence::distances + 2 * TrackSettings::side;

   private:
    static constexpr int padded = (RegionEvidence::distances + 7) / 8 * 8;  // whole vectors
    static void multiply(const float (*h)[padded], const float* inside, float* product);

    float h_[segments][padded];  // of the foreground, for each distance
};

// Adds the colours of lines to histograms, with the weight `rate`.
void learn_colors(const Frame& frame, std::span<const ContourPoint> points, double rate, ColorHistograms& histograms);

}  // namespace edgegrad
