// Samples the directions of paths by the BSDF, without derivatives.
#pragma once

#include <algorithm>
#include <cmath>

#include "core/sobol.h"
#include "shading/lit/bsdf_sampling.h"
#include "shading/lit/lit_surface.h"

namespace edgegrad {

// Samples the cosine or the lobe of a glossy surface, in proportion to the radiance that both send to the viewer.
class PathSample {
   public:
    PathSample(const Surface<double>& o, int channels) : n_(o.n), lobe_(o) {
        if (!lobe_.exists()) return;
        const Scattering<double>& s = o.scattering;
        const double grazing = std::pow(1 - std::clamp(dot(o.n, o.v), 0.0, 1.0), 5);
        double specular = 0, diffuse = 0;
        for (int c = 0; c < channels; ++c) {
            const double f0 = s.f0(c), fresnel = f0 + (1 - f0) * grazing;
            specular += std::fabs(fresnel), diffuse += std::fabs((1 - fresnel) * s.diffuse(c));
        }
        // Both keep a part: what one technique misses has derivatives, too, and channels differ in brightness.
        by_lobe_ =
            std::clamp(specular / std::max(specular + diffuse, 1e-300), least_probability, 1 - least_probability);
    }

    // Returns a direction made from numbers in [0, 1); `choice` selects the technique.
    Vec3 draw(double choice, Vec2 u) const {
        if (choice < by_lobe_) return lobe_.draw(u.x, u.y);
        return draw_by_cosine(n_, u);
    }

    // Returns the pdf with respect to solid angle for a direction above the surface.
    double pdf(Vec3 l) const {
        const double cosine = dot(n_, l) / M_PI;
        return by_lobe_ > 0 ? by_lobe_ * lobe_.pdf(l) + (1 - by_lobe_) * cosine : cosine;
    }

   private:
    static constexpr double least_probability = 0.05;

    Vec3 n_;
    DrawnLobe lobe_;
    double by_lobe_ = 0;
};

// Supplies uniform numbers for the points that paths reach after `steps` steps, from the seeds of their first points. A
// seed's upper half selects the sequences, its lower half the point in them. The sequences are independent, and each
// covers neighbouring pixels evenly (core/sobol.h).
class PathRandomNumbers {
   public:
    PathRandomNumbers(uint64_t seed, int steps)
        : sequence_(seed >> 32), direction_(start(direction, steps)), choice_(start(choice, steps)) {}

    // Returns whether a seed uses the same sequences.
    bool are_of(uint64_t seed) const { return seed >> 32 == sequence_; }
    Vec2 of_direction(uint64_t seed) const { return direction_(uint32_t(seed)); }
    // Returns the numbers that choose the technique and decide Russian roulette.
    Vec2 of_choice(uint64_t seed) const { return choice_(uint32_t(seed)); }
    // Returns the seed for sampling lights.
    static int64_t of_lights(uint64_t seed, int steps) {
        return int64_t(hash(seed >> 32, stream(lights, steps)) << 32 | uint32_t(seed));
    }

   private:
    enum Kind { direction, choice, lights, kinds };
    static uint64_t stream(Kind kind, int steps) { return uint64_t(steps) * kinds + kind; }
    uint64_t start(Kind kind, int steps) const { return hash(sequence_, stream(kind, steps), paths); }

    static constexpr uint64_t paths = 0x7061746873;  // This separates them from the numbers of lights.
    uint64_t sequence_;
    ShuffledSobol direction_, choice_;
};

}  // namespace edgegrad
