// Samples the points of lights for surfaces. Glossy surfaces get antithetic sets where only derivatives are wanted.
#pragma once

#include <algorithm>
#include <vector>

#include "shading/lit/antithetic.h"
#include "shading/lit/light_sample.h"

namespace edgegrad {

// Resamples as Resampled does, but draws, weights and keeps antithetic sets of directions (antithetic.h). The target is
// the sum over the set, and all of its members are evaluated.
class ResampledAntitheticSets {
   public:
    template <class S>
    ResampledAntitheticSets(const LitScene& lit, const Light& light, const RandomNumbers& numbers, const Surface<S>& o,
                            int count, double dark)
        : tables_(lit.tables), light_(light), target_(o, lit.channels, dark), lobe_(o), v_(plain(o.v)), n_(plain(o.n)) {
        const double roughness = plain(o.scattering.roughness);
        alpha_ = std::max(roughness * roughness, least_alpha);
        draw_candidates(lit, light, lobe_, numbers, candidates_for_one * count, shares_,
                        [&](const Candidate& c, bool of_lobe) { add(c.point, c.l, of_lobe); });
    }

    // Writes `count` antithetic sets of points; they have pdf 0 where no light arrives.
    void keep(double u, int count, LightPoint* out) const {
        std::fill(out, out + AntitheticSet::most * count, LightPoint{0, 0, 0, 0});
        if (kept_.empty()) return;
        size_t j = 0;
        for (int s = 0; s < count; ++s, out += AntitheticSet::most) {
            const double at = (s + u) / count * total_;
            while (j + 1 < kept_.size() && kept_[j].running <= at) ++j;
            const AntitheticPoints& antithetic_set = kept_[j];
            for (int k = 0; k < AntitheticSet::most; ++k) {
                out[k] = antithetic_set.point[k];
                const double measure = AntitheticSet::most * antithetic_set.point[k].pdf * total_;
                out[k].pdf = measure > 0 ? antithetic_set.target / measure : 0;
            }
        }
    }

   private:
    struct AntitheticPoints {
        LightPoint point[AntitheticSet::most] = {{0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 0}};
        double target = 0, running = 0;  // `pdf` of a point holds its measure.
    };

    // Adds a candidate. The lobe has no pdf below the surface (bsdf_sampling.h), so its samples there are dropped.
    void add(const LightPoint& p, Vec3 l, bool of_lobe) {
        if (of_lobe && !(dot(n_, l) > 0)) return;
        const AntitheticSet all(v_, n_, alpha_, l);
        AntitheticPoints antithetic_set;
        double by_light = 0, by_lobe = 0;
        for (int k = 0; k < all.count; ++k) {
            const double measure = all.measure[k];
            if (!(measure > 0)) continue;
            LightPoint& point = antithetic_set.point[k] = k == 0 ? p : point_towards(tables_, light_, all.l[k]);
            by_light += measure * point.pdf;
            if (lobe_.exists() && dot(n_, all.l[k]) > 0) by_lobe += measure * lobe_.pdf(all.l[k]);
            const double scattered = target_(all.l[k]);
            if (scattered > 0) antithetic_set.target += measure * scattered * brightness(light_, point);
            point.pdf = measure;
        }
        if (!(antithetic_set.target > 0)) return;
        by_light *= shares_.light, by_lobe *= shares_.lobe;
        total_ += antithetic_set.target * (of_lobe ? by_lobe : by_light) / (by_light * by_light + by_lobe * by_lobe);
        antithetic_set.running = total_;
        kept_.push_back(antithetic_set);
    }

    const std::vector<Table>& tables_;
    const Light& light_;
    Resampled::TargetFunction target_;
    DrawnLobe lobe_;
    Vec3 v_, n_;
    CandidateCounts shares_;
    double alpha_ = 0, total_ = 0;
    std::vector<AntitheticPoints> kept_;
};

// Returns how many antithetic sets replace one sample of a light. More are used at grazing angles, where the face's
// normal differs from the shading normal n by a part of that angle. Light then sets behind the face within the lobe
// (terminator()). All derivatives are noisier there; nearly all noise of such surfaces' motion comes from there.
template <class S>
int sets_of(const Surface<S>& o) {
    constexpr double aside = 0.2, part = 0.1;
    const Vec3 n = plain(o.n), g = plain(o.g), apart = cross(g, n);
    const double nv = std::max(dot(n, plain(o.v)), 0.0);
    return nv < aside && dot(apart, apart) > part * part * nv * nv ? most_sets_for_one : sets_for_one;
}

// Rescales the first `drawn` of `count` points so that they replace all.
inline void stand_for_all(LightPoint* points, int drawn, int count) {
    for (int s = 0; s < drawn; ++s) points[s].pdf *= double(drawn) / count;
    std::fill(points + drawn, points + count, LightPoint{0, 0, 0, 0});
}

// Samples a constant environment for a Lambertian surface by the cosine. Direct light alone keeps its uniform samples.
inline void draw_constant_environment(const LitScene& lit, const Light& light, const RandomNumbers& numbers, Vec3 n,
                                      int count, LightPoint* out) {
    const RandomNumbers::Sequence of_light = numbers.of_light(count);
    for (int s = 0; s < count; ++s) {
        const Vec3 l = draw_by_cosine(n, of_light(s));
        out[s] = point_towards(lit.tables, light, l), out[s].pdf = dot(n, l) / M_PI;
    }
}

// Writes the points of all light samples.
template <class S>
void light_points(const LitScene& lit, const LitPoints& points, const LitOptions& options,
                  const std::vector<LightSample>& lights, int64_t i, const Surface<S>& o, LightPoint* out) {
    for (size_t k = 0; k < lights.size(); k += lights[k].count) {
        const int number = lights[k].light, count = lights[k].count;
        const Light& light = lit.lights[number];
        LightPoint* own = out + k;
        if (options.bounces > 1 && light.kind == Light::Kind::environment && !light.is_image &&
            o.scattering.lambertian && points.forced.light != number) {
            draw_constant_environment(lit, light, RandomNumbers{light, uint64_t(points.seed[i])}, plain(o.n), count,
                                      own);
        } else if (!draws_antithetic(lit, options, light)) {
            light_points(lit, points, i, number, count, options.dark, o, own);
        } else if (o.scattering.lambertian || points.forced.light == number) {
            light_points(lit, points, i, number, options.samples, options.dark, o, own);
            stand_for_all(own, options.samples, count);
        } else {
            const int sets = options.samples * sets_of(o);
            const RandomNumbers numbers{light, uint64_t(points.seed[i])};
            ResampledAntitheticSets(lit, light, numbers, o, sets, options.dark).keep(numbers.of_choice(), sets, own);
            stand_for_all(own, AntitheticSet::most * sets, count);
        }
    }
}

}  // namespace edgegrad
