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
    // `coverage` (H · W): of the image, which cast `spp` rays in each pixel. Rays that hit nothing cost little; `lit`
    // points take the image, and a sample of the gradient, about the same time more.
    template <class T>
    SampleBudget(const T* coverage, int64_t pixels, int spp, bool lit, Team& team) {
        std::vector<int64_t> covered(Team::blocks(pixels), 0);
        team.each_block(pixels, [&](int64_t k, int64_t first, int64_t last) {
            covered[k] = std::count_if(coverage + first, coverage + last, [](T c) { return c > 0; });
        });
        for (const int64_t c : covered) rays_ += (lit ? share_of_lit_image : share_of_image) * double(c) * spp;
    }

    // As many as are wanted, if they cost no more than the rays of the image; else these are shared in proportion to
    // the square roots of what the terms want: the one of which the scene has so much more is cut the most, but its
    // errors are the larger, too.
    SampleCounts share(SampleCounts wanted) const {
        const double surface = rays_a_surface_sample * double(wanted.surface);
        const double edge = rays_an_edge_sample * double(wanted.edge);
        if (surface + edge <= rays_) return wanted;
        const double fair = rays_ * std::sqrt(edge) / (std::sqrt(edge) + std::sqrt(surface));
        const double of_edges = std::clamp(fair, rays_ - surface, std::max(edge, rays_ - surface));
        const double of_surfaces = rays_ - std::min(edge, of_edges);
        return {std::max(std::min(wanted.surface, least), int64_t(of_surfaces / rays_a_surface_sample)),
                std::max(std::min(wanted.edge, least), int64_t(of_edges / rays_an_edge_sample))};
    }

   private:
    // A sample of the gradient costs several rays of the image: it is placed by a search, traced among strangers,
    // decided in double and scattered (docs/performance.md).
    static constexpr double rays_a_surface_sample = 3.9, rays_an_edge_sample = 5.2, share_of_image = 1;
    static constexpr double share_of_lit_image = 4;  // measured on a textured ball under a point light
    static constexpr int64_t least = 1 << 14;  // some milliseconds, so that small images and few rays lose nothing
    double rays_ = 0;
};

}  // namespace edgegrad
