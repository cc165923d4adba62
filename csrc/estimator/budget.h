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

class SampleBudget {
   public:
    // `coverage` (H · W): of the image, which cast `spp` rays in each pixel. Rays that hit nothing cost little.
    template <class T>
    SampleBudget(const T* coverage, int64_t pixels, int spp, bool lit, ThreadTeam& team) : cost_(lit ? shaded : plain) {
        const auto covered = team.map_blocks(pixels, [&](int64_t first, int64_t last) {
            return std::count_if(coverage + first, coverage + last, [](T c) { return c > 0; });
        });
        for (const auto c : covered) rays_ += share_of_image * double(c) * spp;
    }

    // As many as are wanted, if they cost no more than the rays of the image; else these are shared in proportion to
    // the square roots of what the terms want: the one of which the scene has so much more is cut the most, but its
    // errors are the larger, too.
    SampleCounts share(SampleCounts wanted) const {
        const double surface = cost_.surface * double(wanted.surface);
        const double edge = cost_.edge * double(wanted.edge);
        if (surface + edge <= rays_) return wanted;
        const double fair = rays_ * std::sqrt(edge) / (std::sqrt(edge) + std::sqrt(surface));
        const double of_edges = std::clamp(fair, rays_ - surface, std::max(edge, rays_ - surface));
        const double of_surfaces = rays_ - std::min(edge, of_edges);
        return {std::max(std::min(wanted.surface, least), int64_t(of_surfaces / cost_.surface)),
                std::max(std::min(wanted.edge, least), int64_t(of_edges / cost_.edge))};
    }

   private:
    // A sample of the gradient costs several rays of the image: it is placed by a search, traced among strangers,
    // decided in double and scattered; and shaded by lights, each of which it asks whether it sees it, where there are
    // any (docs/tried.md).
    struct Cost {
        double surface, edge;
    };
    static constexpr Cost plain{3.9, 7.0}, shaded{9, 18};
    static constexpr double share_of_image = 1;
    static constexpr int64_t least = 1 << 14;  // some milliseconds, so that small images and few rays lose nothing
    const Cost cost_;
    double rays_ = 0;
};

}  // namespace edgegrad
