// At most so many default samples that the backward pass takes about as long as the image did, whatever the scene: in a
// mesh that is tangled, or many layers deep, the curves and faces in view are many times what is visible.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/parallel.h"

namespace edgegrad {

// Samples of the two terms.
struct SampleCounts {
    int64_t surface = 0, edge = 0;
};

// What things cost in rays of the image, and how a budget is shared (docs/performance.md).
struct SampleCosts {
    // A sample is placed by a search, traced among strangers, decided in double and scattered.
    double surface = 3.9, edge = 5.2;
    double pixel = 0;  // what is shaded of it, beside its rays
    double share = 1;  // of what the image cost, that all samples may cost
    // Terms get parts in proportion to this power of what they want. By the square root, the one of which the scene has
    // so much more is cut the most, but its errors are the larger, too.
    double power = 0.5;
};
// In the light of points. A face in a pixel is shaded once, and so is each sample. What takes its time however few
// samples there are is left out of the share. Without controls both terms feel a cut.
constexpr SampleCosts costs_of_lit{.surface = 16, .edge = 24, .pixel = 12, .share = 0.65, .power = 1};

class SampleBudget {
   public:
    // `coverage` (H · W): of the image, which cast `spp` rays in each pixel. Rays that hit nothing cost little.
    template <class T>
    SampleBudget(const T* coverage, int64_t pixels, int spp, SampleCosts costs, Team& team) : costs_(costs) {
        std::vector<int64_t> covered(Team::blocks(pixels), 0);
        team.each_block(pixels, [&](int64_t k, int64_t first, int64_t last) {
            covered[k] = std::count_if(coverage + first, coverage + last, [](T c) { return c > 0; });
        });
        for (const int64_t c : covered) rays_ += costs.share * double(c) * (spp + costs.pixel);
    }

    // As many as are wanted, if they cost no more than that; else it is shared.
    SampleCounts share(SampleCounts wanted) const {
        const double surface = costs_.surface * double(wanted.surface);
        const double edge = costs_.edge * double(wanted.edge);
        if (surface + edge <= rays_) return wanted;
        const double by_edges = std::pow(edge, costs_.power), by_surfaces = std::pow(surface, costs_.power);
        const double fair = rays_ * by_edges / (by_edges + by_surfaces);
        const double of_edges = std::clamp(fair, rays_ - surface, std::max(edge, rays_ - surface));
        const double of_surfaces = rays_ - std::min(edge, of_edges);
        return {std::max(std::min(wanted.surface, least), int64_t(of_surfaces / costs_.surface)),
                std::max(std::min(wanted.edge, least), int64_t(of_edges / costs_.edge))};
    }

   private:
    static constexpr int64_t least = 1 << 14;  // some milliseconds, so that small images and few rays lose nothing
    const SampleCosts costs_;
    double rays_ = 0;
};

}  // namespace edgegrad
