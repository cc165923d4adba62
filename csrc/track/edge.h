// Computes the likelihood of a contour's position from the pixels across it, to a fraction of a pixel. Linear radiance
// is
//
//     I(r) = (c_in + g_in (r - d)) (1 - Phi((r - d) / blur)) + (c_out + g_out (r - d)) Phi((r - d) / blur) + noise
//
// with Phi the normal distribution function, which is the lens's blur. Colours and trends are linear, and projected out
// (variable projection, Golub and Pereyra 1973); the noise is normal with an unknown deviation, which is integrated out
// under Jeffreys' prior, so p(d) ~ SSE(d)^-n, with n half the number of independent residuals. The trends have a
// g-prior of unit information, under which a model's likelihood is closed (Liang et al., JASA 2008), or there are none.
// The models' probabilities are learnt from the object's lines (empirical Bayes), and their likelihoods are added up. A
// trend on one side alone takes a part of the blurred edge for itself: at true poses its edges lay 0.5 ... 1 px further
// outside, those of both models less than 0.1 px.
#pragma once

#include "track/contour.h"
#include "track/frame.h"

namespace edgegrad {

// Holds the probabilities of the models of the colours on both sides: constant, and with trends.
struct SideModels {
    static constexpr int count = 2;
    double probability[count] = {0.5, 0.5};
};

class EdgeModel {
   public:
    static constexpr int pixels = 2 * TrackSettings::across + 1;
    static constexpr int distances = int(2 * TrackSettings::edge_reach / TrackSettings::edge_step) + 1;
    static constexpr int padded = (distances + 7) / 8 * 8;  // whole vectors

    EdgeModel();

    static double distance(int d) { return (d - distances / 2) * TrackSettings::edge_step; }

    // Writes the likelihoods (distances,) of linear colours (pixels, 4) at r = -across ... across, up to a common
    // factor, and adds the posterior probabilities of the models to `shares`. `moving` also allows for the blur of
    // motion.
    void evaluate(const float (*I)[4], const SideModels& models, bool moving, float* out, double* shares) const;
    // Reads the colours from a frame.
    void evaluate(const Frame& frame, const ContourPoint& point, const SideModels& models, bool moving, float* out,
                  double* shares) const;

   private:
    // Holds the orthonormal columns of the model, times the root of the weights, at each distance.
    struct Basis {
        float weight[pixels][padded], column[4][pixels][padded];
    };
    // Adds the likelihoods of each model.
    static void add_likelihoods(const Basis& basis, const float (*I)[4], float (*out)[padded]);

    Basis basis_[2];  // still, moving
};

}  // namespace edgegrad
