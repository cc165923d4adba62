// This file limits the default samples, so that the backward pass takes about as long as the image for any scene. In a
// tangled mesh, or one many layers deep, the curves and faces in view are many times what is visible.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/parallel.h"
#include "estimator/default_samples.h"
#include "estimator/gradient_input.h"

namespace edgegrad {

// SampleCounts holds the samples of the two terms.
struct SampleCounts {
    int64_t surface = 0, edge = 0;
};

class SampleBudget {
   public:
    // `coverage` (H · W) belongs to the image, which cast `spp` rays in each pixel. Rays that hit nothing cost little.
    template <class T>
    SampleBudget(const T* coverage, int64_t pixels, int spp, const GradientOptions& o, ThreadTeam& team)
        : cost_(o.indirect ? indirect
                : o.lit    ? shaded
                           : plain),
          least_samples_(int64_t(usual_least_samples * sample_growth(spp))) {
        const auto covered = team.map_blocks(pixels, [&](int64_t first, int64_t last) {
            return std::count_if(coverage + first, coverage + last, [](T c) { return c > 0; });
        });
        for (const auto c : covered) rays_ += share_of_image * double(c) * spp;
    }

    // Returns the wanted samples, if they cost no more than the rays of the image. Otherwise the terms share the budget
    // in proportion to the square roots of their wants. The larger one is cut the most, but its errors are larger, too.
    SampleCounts share(SampleCounts wanted) const {
        const double surface = cost_.surface * double(wanted.surface);
        const double edge = cost_.edge * double(wanted.edge);
        if (surface + edge <= rays_) return wanted;
        const double fair = rays_ * std::sqrt(edge) / (std::sqrt(edge) + std::sqrt(surface));
        const double of_edges = std::clamp(fair, rays_ - surface, std::max(edge, rays_ - surface));
        const double of_surfaces = rays_ - std::min(edge, of_edges);
        return {std::max(std::min(wanted.surface, least_samples_), int64_t(of_surfaces / cost_.surface)),
                std::max(std::min(wanted.edge, least_samples_), int64_t(of_edges / cost_.edge))};
    }

   private:
    // Cost is in rays of the image. A sample of the gradient is placed by a search, traced incoherently, decided in
    // double precision and scattered. With lights, it is also shaded by each light that it sees (docs/tried.md). With
    // indirect light, paths take most of the time of both.
    struct Cost {
        double surface, edge;
    };
    static constexpr Cost plain{3.9, 7.0}, shaded{9, 18}, indirect{2, 4};
    static constexpr double share_of_image = 1;
    // These samples take some milliseconds, so that small images and few rays lose nothing.
    static constexpr double usual_least_samples = 1 << 14;
    const Cost cost_;
    const int64_t least_samples_;
    double rays_ = 0;
};

}  // namespace edgegrad
