// Samples points of lights that illuminate a surface (next-event estimation), and evaluates their contributions to its
// radiance. A sample's pdf is with respect to area on meshes, and to solid angle on environments.
#pragma once

#include <cstdint>
#include <vector>

#include "core/sobol.h"
#include "shading/lit/bsdf_sampling.h"
#include "shading/lit/environment.h"
#include "shading/lit/lit_surface.h"
#include "shading/lit/mesh_light_sampling.h"
#include "shading/lit/punctual.h"

namespace edgegrad {

// Returns what arrives at y from a point of a light.
template <class S>
Arriving<S> arriving(const LitScene& lit, const Light& light, const LightPoint& point, Vector<S> y) {
    switch (light.kind) {
        case Light::Kind::directional:
            return from_direction<S>(lit.tables, light, lit.channels);
        case Light::Kind::environment:
            return from_environment<S>(lit.tables, light, lit.channels, point);
        case Light::Kind::mesh:
            return from_faces<S>(lit.tables, lit.emitter(light), point, lit.channels, y);
        default:
            return from_point<S>(lit.tables, light, lit.channels, y);
    }
}
inline void arriving_vjp(const LitScene& lit, const Light& light, const LightPoint& point, Vec3 y,
                         const Arriving<double>& bar, Vec3& y_bar, Cotangents& to) {
    switch (light.kind) {
        case Light::Kind::directional:
            return from_direction_vjp(lit.tables, light, lit.channels, bar, to);
        case Light::Kind::environment:
            return from_environment_vjp(lit.tables, light, lit.channels, point, bar, to);
        case Light::Kind::mesh:
            return from_faces_vjp(lit.tables, lit.emitter(light), point, lit.channels, y, bar, y_bar, to);
        default:
            return from_point_vjp(lit.tables, light, lit.channels, y, bar, y_bar, to);
    }
}

// Returns the position of a point of a light, or the unit direction towards it if it lies at infinity.
inline Vec3 place(const LitScene& lit, const Light& light, const LightPoint& p) {
    const std::vector<Table>& tables = lit.tables;
    switch (light.kind) {
        case Light::Kind::directional:
            return -unit(direction_of<double>(tables, light));
        case Light::Kind::environment:
            return unit(Rotation<double>::of(tables, light).to_world(own_direction(light, p)));
        case Light::Kind::mesh: {
            const EmissiveFaces from = lit.emitter(light);
            const FacePoint<double> at = on_emitter<double>(from, p);
            Vec3 sum;
            for (int i = 0; i < 3; ++i) sum += at.b[i] * tables[lit.verts].vector_at<double>(at.vertex[i]);
            return sum;
        }
        default:
            return tables[light.position].vector_at<double>(0);
    }
}

// Supplies uniform numbers for one point and light. They fill the unit square evenly over the points of a pixel, and of
// blocks of pixels (edgegrad/points/sobol.py). A seed's upper half selects the sequence, its lower half the point in
// it. Each point takes as many consecutive numbers as it needs.
struct RandomNumbers {
    const Light& light;
    uint64_t seed;

    // Supplies `count` numbers of one kind by their index.
    class Sequence {
       public:
        Sequence(const RandomNumbers& of, int kind, int count)
            : sobol_(hash(of.seed >> 32, of.light.stream[kind])), first_(uint32_t(of.seed) * uint32_t(count)) {}
        Vec2 operator()(int j) const { return sobol_(first_ + uint32_t(j)); }

       private:
        ShuffledSobol sobol_;
        uint32_t first_;
    };

    Sequence of_light(int count) const { return Sequence(*this, 0, count); }
    Sequence of_lobe(int count) const { return Sequence(*this, 1, count); }
    double of_choice() const { return Sequence(*this, 2, 1)(0).x; }
};

// Holds how many candidates each technique draws.
struct CandidateCounts {
    double light = 0, lobe = 0;
};

// Calls add(candidate, whether the lobe drew it) for `all` points of a light. The lobe draws half of them if `ask_lobe`
// is set. `shares` gets the number of both kinds first. by_light(numbers, add) and towards(direction, add) define the
// candidates.
template <class ByLight, class Towards, class Add>
void draw_candidates(const DrawnLobe& lobe, const RandomNumbers& numbers, int all, bool ask_lobe,
                     CandidateCounts& shares, ByLight by_light, Towards towards, Add add) {
    const int of_all = ask_lobe ? all / 2 : 0, others = all - of_all;
    shares.light = others, shares.lobe = of_all;
    const RandomNumbers::Sequence of_light = numbers.of_light(others);
    for (int j = 0; j < others; ++j) by_light(of_light(j), [&](const Candidate& c) { add(c, false); });
    const RandomNumbers::Sequence of_lobe = numbers.of_lobe(of_all);
    for (int j = 0; j < of_all; ++j) {
        const Vec2 u = of_lobe(j);
        towards(lobe.draw(u.x, u.y), [&](const Candidate& c) { add(c, true); });
    }
}
// Draws candidates from an environment.
template <class Add>
void draw_candidates(const LitScene& lit, const Light& light, const DrawnLobe& lobe, const RandomNumbers& numbers,
                     int all, CandidateCounts& shares, Add add) {
    const Rotation<double> turn = Rotation<double>::of(lit.tables, light);
    draw_candidates(
        lobe, numbers, all, lobe.exists(), shares,
        [&](Vec2 u, auto add_one) {
            const LightPoint p = draw(light, u);
            const Vec3 own = own_direction(light, p);
            add_one(Candidate{p, light.rotation == no_table ? own : unit(turn.to_world(own)), brightness(light, p)});
        },
        [&](Vec3 l, auto add_one) {
            const LightPoint p = point_towards(lit.tables, light, l);
            add_one(Candidate{p, l, brightness(light, p)});
        },
        add);
}

// This many candidates are drawn for each point, or each antithetic set of points, that is kept.
constexpr int candidates_for_one = 8;

// Samples points of a light for a glossy surface by resampled importance sampling (Talbot et al. 2005). The target is
// the unoccluded radiance that a point adds. The light and the lobe draw candidates, weighted by the power heuristic
// (Veach and Guibas 1995). `count` candidates are kept in proportion to target / pdf. Their pdf is the target over its
// integral, which the candidates estimate.
class Resampled {
   public:
    template <class S>
    Resampled(const LitScene& lit, const Light& light, const RandomNumbers& numbers, const Surface<S>& o, int count,
              double dark)
        : target_(o, lit.channels, dark), lobe_(o) {
        kept_.reserve(candidates_for_one * count), running_.reserve(candidates_for_one * count);
        const auto add_one = [&](const Candidate& c, bool of_lobe) { add(c, of_lobe); };
        if (light.kind == Light::Kind::environment) {
            draw_candidates(lit, light, lobe_, numbers, candidates_for_one * count, shares_, add_one);
        } else {
            const EmissiveMeshSampler mesh(lit, light, lobe_, plain(o.y), o.at.face + o.mesh->first_face);
            draw_candidates(
                lobe_, numbers, mesh.interchangeable() ? count : candidates_for_one * count, mesh.by_lobe(), shares_,
                [&](Vec2 u, auto add) { mesh.draw_by_light(u, add); },
                [&](Vec3 l, auto add) { mesh.each_towards(l, add); }, add_one);
        }
    }

    // Writes `count` points; they have pdf 0 where no light arrives.
    void keep(double u, int count, LightPoint* out) const {
        if (kept_.empty()) return void(std::fill(out, out + count, LightPoint{0, 0, 0, 0}));
        size_t j = 0;
        for (int s = 0; s < count; ++s) {
            const double at = (s + u) / count * total_;
            while (j + 1 < kept_.size() && running_[j] <= at) ++j;
            out[s] = kept_[j], out[s].pdf /= total_;
        }
    }

    // Evaluates the BSDF times the cosine. Nearly black colours become `dark`, as they have derivatives, too.
    class TargetFunction {
       public:
        template <class S>
        TargetFunction(const Surface<S>& o, int channels, double dark)
            : v_(plain(o.v)), n_(plain(o.n)), g_(plain(o.g)), roughness_(plain(o.scattering.roughness)) {
            const double metallic = plain(o.scattering.metallic);
            for (int c = 0; c < channels; ++c) {
                const double base = plain(o.scattering.base[c]);
                diffuse_ += std::fabs(base * (1 - metallic)) / channels;
                head_on_ += std::fabs(reflectance_of_dielectrics * (1 - metallic) + base * metallic) / channels;
            }
            diffuse_ = std::max(diffuse_, dark) / M_PI, head_on_ = std::max(head_on_, dark);
        }
        double operator()(Vec3 l) const {
            const double nl = dot(n_, l);
            if (!(nl > 0 && dot(g_, l) > 0)) return 0;
            const Lobe<double> o = lobe(roughness_, v_, n_, l);
            const double fresnel = head_on_ + (1 - head_on_) * o.grazing5;
            return nl * (std::fabs(1 - fresnel) * diffuse_ + std::fabs(fresnel) * o.specular());
        }

       private:
        Vec3 v_, n_, g_;
        double roughness_, diffuse_ = 0, head_on_ = 0;
    };

   private:
    void add(const Candidate& c, bool of_lobe) {
        if (!(c.solid_angle > 0)) return;
        const double target = target_(c.l) * c.brightness * c.solid_angle;
        if (!(target > 0)) return;
        const double by_light = shares_.light * c.point.pdf,
                     by_lobe = shares_.lobe > 0 ? shares_.lobe * lobe_.pdf(c.l) * c.solid_angle : 0;
        const double own = of_lobe ? by_lobe : by_light;
        total_ += target * own / (by_light * by_light + by_lobe * by_lobe);
        kept_.push_back(c.point), running_.push_back(total_);
        kept_.back().pdf = target;
    }

    TargetFunction target_;
    DrawnLobe lobe_;
    CandidateCounts shares_;
    double total_ = 0;
    std::vector<LightPoint> kept_;
    std::vector<double> running_;
};

// Writes the `count` points of a light that illuminate point i of a surface.
template <class S>
void light_points(const LitScene& lit, const LitPoints& points, int64_t i, int number, int count, double dark,
                  const Surface<S>& o, LightPoint* out) {
    const Light& light = lit.lights[number];
    const ForcedLight& forced = points.forced;
    const RandomNumbers numbers{light, uint64_t(points.seed[i])};
    if (light.is_punctual()) {
        out[0] = {};
    } else if (forced.light == number) {
        std::fill(out, out + count, LightPoint{forced.index[i], forced.uv[2 * i], forced.uv[2 * i + 1], forced.pdf[i]});
    } else if ((light.kind == Light::Kind::environment || light.tree) && !o.scattering.lambertian) {
        Resampled(lit, light, numbers, o, count, dark).keep(numbers.of_choice(), count, out);
    } else {
        const RandomNumbers::Sequence of_light = numbers.of_light(count);
        for (int s = 0; s < count; ++s) {
            out[s] = draw(light, of_light(s));
            if (light.kind == Light::Kind::environment) out[s] = above(lit.tables, light, out[s], plain(o.g));
        }
    }
}

// Adds the unoccluded contribution of one light sample: f E max(0, n·l).
template <class S>
void add_light(const LitScene& lit, const Light& light, const LightPoint& point, double share, const Surface<S>& o,
               S* total) {
    const Arriving<S> a = arriving<S>(lit, light, point, o.y);
    S f[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    S cosine = S(share) * dot(o.n, a.l);
    if (!o.mesh->normal.is_flat()) cosine *= terminator<S>(o.g, o.n, a.l);
    for (int c = 0; c < lit.channels; ++c) total[c] += f[c] * a.E[c] * cosine;
}
inline void add_light_vjp(const LitScene& lit, const Light& light, const LightPoint& point, double share,
                          const Surface<double>& o, const double* total_bar, SurfaceBar& bar, Cotangents& to) {
    const Arriving<double> a = arriving<double>(lit, light, point, o.y);
    double f[most_lit_channels], f_bar[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    const double nl = dot(o.n, a.l), t = o.mesh->normal.is_flat() ? 1 : terminator<double>(o.g, o.n, a.l);
    Arriving<double> a_bar;
    double cosine_bar = 0;
    for (int c = 0; c < lit.channels; ++c) {
        cosine_bar += total_bar[c] * f[c] * a.E[c];
        f_bar[c] = total_bar[c] * a.E[c] * share * nl * t, a_bar.E[c] = total_bar[c] * f[c] * share * nl * t;
    }
    scatter_vjp(o.scattering, o.v, o.n, a.l, lit.channels, f_bar, bar.scattering, bar.v, bar.n, a_bar.l);
    dot_vjp(o.n, a.l, cosine_bar * share * t, bar.n, a_bar.l);
    if (!o.mesh->normal.is_flat()) terminator_vjp(o.g, o.n, a.l, cosine_bar * share * nl, bar.g, bar.n, a_bar.l);
    arriving_vjp(lit, light, point, o.y, a_bar, bar.y, to);
}

}  // namespace edgegrad
