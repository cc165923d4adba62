// Directions from which light comes that a surface scatters on a path, drawn without derivatives.
#pragma once

#include <algorithm>
#include <cmath>

#include "core/sobol.h"
#include "shading/lit/bsdf_sampling.h"
#include "shading/lit/lit_surface.h"

namespace edgegrad {

// By the cosine, or by the lobe of a glossy surface, in the proportion of what both send to the viewer.
class PathSample {
   public:
    PathSample(const Surface<double>& o, int channels) : n_(o.n), lobe_(o) {
        if (!lobe_.exists()) return;
        const Scattering<double>& s = o.scattering;
        const double grazing = std::pow(1 - std::clamp(dot(o.n, o.v), 0.0, 1.0), 5);
        double specular = 0, diffuse = 0;
        for (int c = 0; c < channels; ++c) {
            const double f0 = reflectance_of_dielectrics + (s.base[c] - reflectance_of_dielectrics) * s.metallic;
            const double fresnel = f0 + (1 - f0) * grazing;
            specular += std::fabs(fresnel), diffuse += std::fabs((1 - fresnel) * s.diffuse(c));
        }
        // What one of them misses has derivatives too, and what seems dark in one channel may not be in another.
        by_lobe_ = std::clamp(specular / std::max(specular + diffuse, 1e-300), least, 1 - least);
    }

    // From numbers in [0, 1), the first of which chooses.
    Vec3 draw(double choice, Vec2 u) const {
        if (choice < by_lobe_) return lobe_.draw(u.x, u.y);
        return draw_by_cosine(n_, u);
    }

    // By solid angle, of a direction above the normal.
    double pdf(Vec3 l) const {
        const double cosine = dot(n_, l) / M_PI;
        return by_lobe_ > 0 ? by_lobe_ * lobe_.pdf(l) + (1 - by_lobe_) * cosine : cosine;
    }

   private:
    static constexpr double least = 0.05;

    Vec3 n_;
    DrawnLobe lobe_;
    double by_lobe_ = 0;
};

// Uniform numbers of the points of paths that are reached after so many steps, from the seeds of the first ones. The
// upper half of a seed says which sequences, the lower which of their points. They know nothing of each other, and each
// is spread evenly over pixels (core/sobol.h).
class PathRandomNumbers {
   public:
    PathRandomNumbers(uint64_t seed, int steps)
        : sequence_(seed >> 32), direction_(start(direction, steps)), choice_(start(choice, steps)) {}

    // Whether a seed has the same sequences.
    bool are_of(uint64_t seed) const { return seed >> 32 == sequence_; }
    Vec2 of_direction(uint64_t seed) const { return direction_(uint32_t(seed)); }
    // Of what draws the direction, and of whether the path goes on.
    Vec2 of_choice(uint64_t seed) const { return choice_(uint32_t(seed)); }
    // The seed of points of lights.
    static int64_t of_lights(uint64_t seed, int steps) {
        return int64_t(hash(seed >> 32, stream(lights, steps)) << 32 | uint32_t(seed));
    }

   private:
    enum Kind { direction, choice, lights, kinds };
    static uint64_t stream(Kind kind, int steps) { return uint64_t(steps) * kinds + kind; }
    uint64_t start(Kind kind, int steps) const { return hash(sequence_, stream(kind, steps), paths); }

    static constexpr uint64_t paths = 0x7061746873;  // so that they meet no numbers of lights
    uint64_t sequence_;
    ShuffledSobol direction_, choice_;
};

}  // namespace edgegrad
