// Keeps histograms of the colours inside and outside the contour: local ones that stay with the mesh (tclc: Tjaden et
// al., TPAMI 2018), backed off to the global pair, as a Dirichlet prior does.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <vector>

#include "track/frame.h"
#include "track/settings.h"
#include "track/tracked_mesh.h"

namespace edgegrad {

// Names the local histograms that count at a point of the mesh.
using NearCentres = std::array<int32_t, TrackSettings::nearest>;

struct ColorEvidence {
    float log_ratio;  // log p(color | inside) - log p(color | outside)
    bool known;       // whether it is a colour of either side
};

class ColorHistograms {
   public:
    explicit ColorHistograms(const TrackedMesh& mesh);

    NearCentres near(Vec3 X) const;

    // Sets where the next lookups are, on a line.
    void look_at(const NearCentres& centres);
    ColorEvidence evidence(int bin) const {
        float inside = backed_ * whole_[bin][0], outside = backed_ * whole_[bin][1];
        for (int k = 0; k < TrackSettings::nearest; ++k) inside += at_[k][bin][0], outside += at_[k][bin][1];
        inside *= per_pixel_[0], outside *= per_pixel_[1];
        constexpr float most = float(TrackSettings::greatest_ratio);
        const float ratio = std::log(inside / outside);
        return {ratio < -most  ? -most
                : ratio > most ? most
                               : ratio,
                (inside > outside ? inside : outside) > float(TrackSettings::known_share / Frame::bins)};
    }

    // Adds colours: begin, then a pixel of a side (0: inside, 1: outside) after the other, then end with the weight of
    // the new ones.
    void begin_learning();
    void learn(const NearCentres& centres, int bin, int side);
    void end_learning(double rate);
    // Forgets all colours.
    void clear();

    // These are all numbers that are learnt, for saving them.
    std::span<float> state() { return state_; }
    std::span<const float> state() const { return state_; }
    // Updates what follows from them.
    void restore();

   private:
    using Pair = float[2];
    Pair* local(int centre) { return reinterpret_cast<Pair*>(state_.data() + 2 * (int64_t(centre) + 1) * Frame::bins); }
    const Pair* local(int centre) const { return const_cast<ColorHistograms*>(this)->local(centre); }
    Pair* counts() { return reinterpret_cast<Pair*>(state_.data()); }

    const TrackedMesh& mesh_;
    std::vector<float> state_;  // (1 + centres, bins, 2): the global pair, then the local ones
    std::vector<float> whole_values_;
    Pair* whole_;  // (bins,) the global pair as probabilities
    std::array<std::array<float, 2>, TrackSettings::centres> sum_{};
    struct Seen {
        NearCentres centres;
        int32_t bin;
        int32_t side;
    };
    std::vector<Seen> seen_;

    float backed_ = 0, per_pixel_[2] = {};
    const Pair* at_[TrackSettings::nearest] = {};
};

}  // namespace edgegrad
