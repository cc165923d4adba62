// Light samples: points of lights that light a surface, and what one of them adds to its radiance.
#pragma once

#include <cstdint>
#include <vector>

#include "shading/lit/environment.h"
#include "shading/lit/lit_surface.h"
#include "shading/lit/lobe_draw.h"
#include "shading/lit/punctual.h"

namespace edgegrad {

// What arrives at y from a point of a light.
template <class S>
Arriving<S> arriving(const LitScene& lit, const Lamp& lamp, const LightPoint& point, Vector<S> y) {
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return from_direction<S>(lit.tables, lamp, lit.channels);
        case Lamp::Kind::environment:
            return from_environment<S>(lit.tables, lamp, lit.channels, point);
        case Lamp::Kind::mesh:
            return from_faces<S>(lit.tables, lit.emitter(lamp), point, lit.channels, y);
        default:
            return from_point<S>(lit.tables, lamp, lit.channels, y);
    }
}
inline void arriving_vjp(const LitScene& lit, const Lamp& lamp, const LightPoint& point, Vec3 y,
                         const Arriving<double>& bar, Vec3& y_bar, Cotangents& to) {
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return from_direction_vjp(lit.tables, lamp, lit.channels, bar, to);
        case Lamp::Kind::environment:
            return from_environment_vjp(lit.tables, lamp, lit.channels, point, bar, to);
        case Lamp::Kind::mesh:
            return from_faces_vjp(lit.tables, lit.emitter(lamp), point, lit.channels, y, bar, y_bar, to);
        default:
            return from_point_vjp(lit.tables, lamp, lit.channels, y, bar, y_bar, to);
    }
}

// The place of a point of a light; of one at infinity, the unit direction towards it.
inline Vec3 place(const LitScene& lit, const Lamp& lamp, const LightPoint& p) {
    const std::vector<Table>& tables = lit.tables;
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return -unit(direction_of<double>(tables, lamp));
        case Lamp::Kind::environment:
            return unit(Rotation<double>::of(tables, lamp).to_world(own_direction(lamp, p)));
        case Lamp::Kind::mesh: {
            const EmissiveFaces from = lit.emitter(lamp);
            const FacePoint<double> at = on_emitter<double>(from, p);
            Vec3 sum;
            for (int i = 0; i < 3; ++i) sum += at.b[i] * tables[lit.verts].vector_at<double>(at.vertex[i]);
            return sum;
        }
        default:
            return tables[lamp.position].vector_at<double>(0);
    }
}

// Uniform numbers of one point and lamp, that fill the unit cube evenly (edgegrad/points/seeds.py): number k of part j
// of so many.
struct Numbers {
    const LitScene& lit;
    const Lamp& lamp;
    uint64_t seed;

    double operator()(int k, int j, int count) const {
        const uint64_t part = seed * uint64_t(count) + uint64_t(j);
        return double((part * lit.step[k % 3] + lamp.stream[k]) >> 11) * 0x1p-53;
    }
};

// Calls add(point, its direction, whether the lobe drew it) for so many points of an environment, half of them by the
// lobe if it is narrow, and writes how many of both kinds there are.
template <class Add>
void candidates(const LitScene& lit, const Lamp& lamp, const DrawnLobe& lobe, const Numbers& numbers, int all,
                double& share_light, double& share_lobe, Add add) {
    const int by_lobe = lobe.exists() ? all / 2 : 0, by_light = all - by_lobe;
    share_light = by_light, share_lobe = by_lobe;
    const Rotation<double> turn = Rotation<double>::of(lit.tables, lamp);
    for (int j = 0; j < by_light; ++j) {
        const double u[3] = {numbers(0, j, by_light), numbers(1, j, by_light), numbers(2, j, by_light)};
        const LightPoint p = draw(lamp, u);
        const Vec3 own = own_direction(lamp, p);
        add(p, lamp.rotation == no_table ? own : unit(turn.to_world(own)), false);
    }
    for (int j = 0; j < by_lobe; ++j) {
        const Vec3 l = lobe.draw(numbers(3, j, by_lobe), numbers(4, j, by_lobe));
        add(point_towards(lit.tables, lamp, l), l, true);
    }
}

// Points of an environment, drawn by what they give to a glossy surface where nothing lies between, the target: of
// candidates that the light and the lobe have drawn, and that the power heuristic weights (Veach and Guibas 1995),
// `count` are kept in proportion to target / density (resampled importance sampling, Talbot et al. 2005). Their density
// is the target over its integral as the candidates estimate it.
class Resampled {
   public:
    static constexpr int each = 8;  // candidates for one that is kept

    template <class S>
    Resampled(const LitScene& lit, const Lamp& lamp, const Numbers& numbers, const Surface<S>& o, int count,
              double dark)
        : lamp_(lamp), target_(o, lit.channels, dark), lobe_(o) {
        const int all = each * count;
        kept_.reserve(all), running_.reserve(all);
        candidates(lit, lamp, lobe_, numbers, all, share_light_, share_lobe_,
                   [&](const LightPoint& p, Vec3 l, bool of_lobe) { add(p, l, of_lobe); });
    }

    // Writes `count` points; ones that do not exist where nothing arrives.
    void keep(double u, int count, LightPoint* out) const {
        if (kept_.empty()) return void(std::fill(out, out + count, LightPoint{0, 0, 0, 0}));
        size_t j = 0;
        for (int s = 0; s < count; ++s) {
            const double at = (s + u) / count * total_;
            while (j + 1 < kept_.size() && running_[j] <= at) ++j;
            out[s] = kept_[j], out[s].density /= total_;
        }
    }

    // What a surface makes of light, but for colours that are nearly black, of which there are derivatives too.
    class Target {
       public:
        template <class S>
        Target(const Surface<S>& o, int channels, double dark)
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
    void add(LightPoint p, Vec3 l, bool of_lobe) {
        const double target = target_(l) * brightness(lamp_, p);
        if (!(target > 0)) return;
        const double by_light = share_light_ * p.density, by_lobe = lobe_.exists() ? share_lobe_ * lobe_.density(l) : 0;
        const double own = of_lobe ? by_lobe : by_light;
        total_ += target * own / (by_light * by_light + by_lobe * by_lobe);
        p.density = target;
        kept_.push_back(p), running_.push_back(total_);
    }

    const Lamp& lamp_;
    Target target_;
    DrawnLobe lobe_;
    double share_light_ = 0, share_lobe_ = 0, total_ = 0;
    std::vector<LightPoint> kept_;
    std::vector<double> running_;
};

// The points of a lamp that point i of a surface is lit by: `count` of them.
template <class S>
void light_points(const LitScene& lit, const LitPoints& points, int64_t i, int number, int count, double dark,
                  const Surface<S>& o, LightPoint* out) {
    const Lamp& lamp = lit.lamps[number];
    const ForcedLight& forced = points.forced;
    const Numbers numbers{lit, lamp, uint64_t(points.seed[i])};
    if (lamp.is_punctual()) {
        out[0] = {};
    } else if (forced.lamp == number) {
        std::fill(out, out + count,
                  LightPoint{forced.index[i], forced.uv[2 * i], forced.uv[2 * i + 1], forced.density[i]});
    } else if (lamp.kind == Lamp::Kind::environment && !o.scattering.lambertian) {
        Resampled(lit, lamp, numbers, o, count, dark).keep(numbers(5, 0, 1), count, out);
    } else {
        for (int s = 0; s < count; ++s) {
            const double u[3] = {numbers(0, s, count), numbers(1, s, count), numbers(2, s, count)};
            out[s] = draw(lamp, u);
            if (lamp.kind == Lamp::Kind::environment) out[s] = above(lit.tables, lamp, out[s], plain(o.g));
        }
    }
}

// What one light sample adds, before it is known to be seen: f E max(0, n·l).
template <class S>
void add_light(const LitScene& lit, const Lamp& lamp, const LightPoint& point, double share, const Surface<S>& o,
               S* total) {
    const Arriving<S> a = arriving<S>(lit, lamp, point, o.y);
    S f[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    S cosine = S(share) * dot(o.n, a.l);
    if (!o.mesh->normal.is_flat()) cosine *= terminator<S>(o.g, o.n, a.l);
    for (int c = 0; c < lit.channels; ++c) total[c] += f[c] * a.E[c] * cosine;
}
inline void add_light_vjp(const LitScene& lit, const Lamp& lamp, const LightPoint& point, double share,
                          const Surface<double>& o, const double* total_bar, SurfaceBar& bar, Cotangents& to) {
    const Arriving<double> a = arriving<double>(lit, lamp, point, o.y);
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
    arriving_vjp(lit, lamp, point, o.y, a_bar, bar.y, to);
}

}  // namespace edgegrad
