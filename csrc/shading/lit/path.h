// Traces paths backwards from points of surfaces, for light that surfaces have scattered before: light, xₙ, …, x₂, x₁,
// viewer. It uses next-event estimation, MIS by the balance heuristic for images, and Russian roulette.
//
// Paths are sampled once, without derivatives; path_radiance.h evaluates them as a function of what moves. Each point
// x₂ … stays at the barycentrics of its face while faces move, and the pdfs of all samples are constants. Paths that
// kept their directions instead would give biased derivatives for moving surfaces (Worchel, Finnendahl and Alexa 2025).
//
// Next-event estimation samples lights at a path's points as it does at points that are seen (light_sample.h), by the
// light and by the BSDF. It thereby already counts emitters that a sampled direction hits; the path does not count them
// again. Only images, which need no derivatives, apply MIS (Veach and Guibas 1995) to Lambertian surfaces. There,
// samples of the light alone share their weight with the path's direction. A path ends at meshes without a material, at
// back faces of one-sided materials, and where its ray leaves the scene.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <vector>

#include "rays/trace.h"
#include "shading/lit/path_sampling.h"
#include "shading/lit/visibility.h"

namespace edgegrad {

constexpr int steps_without_russian_roulette = 2;
constexpr double least_russian_roulette_probability = 0.05;

// Returns the solid angle of a face per unit of its last two barycentrics, seen from the displacement d: |M · d| /
// |d|³. M is the cross product of two sides of the face.
template <class S>
S solid_angle(const Surface<S>& o, Vector<S> d) {
    const Vector<S> M = cross(o.frame.corner[1] - o.frame.corner[0], o.frame.corner[2] - o.frame.corner[0]);
    const S facing = dot(M, d), squared = dot(d, d);
    return S(plain(facing) < 0 ? -1 : 1) * facing / (squared * sqrt(squared));
}

// Holds the point of an emitter that the path's sampled direction hits. By the balance heuristic, its pdf is the sum of
// the pdfs of both sampling techniques. Light samples for the same point of the path have the same kind of pdf.
struct EmitterHit {
    int light = -1;  // −1 means no hit.
    LightPoint point;
};

// Views one path of `points` points. Arrays begin at its first point; the next one is `stride` elements further, or as
// many rows of `lights`.
struct Path {
    int points;
    const int64_t* face;
    const double* b;    // (3,) barycentrics
    const double* pdf;  // The pdf of the last two barycentrics, as the previous point samples them, times the
                        // probability of survival.
    const LightPoint* drawn;
    const int8_t* seen;
    size_t stride, lights;
    const EmitterHit* emitter_hits;  // Null means that hits of emitters do not count.

    int64_t face_at(int k) const { return face[k * stride]; }
    const double* b_at(int k) const { return b + 3 * k * stride; }
    double pdf_at(int k) const { return pdf[k * stride]; }
    const LightPoint* drawn_at(int k) const { return drawn + k * stride * lights; }
    const int8_t* seen_at(int k) const { return seen + k * stride * lights; }
    bool has_emitter_hit(int k) const { return emitter_hits && emitter_hits[k * stride].light >= 0; }
    const EmitterHit& emitter_hit_at(int k) const { return emitter_hits[k * stride]; }
};

// Holds the paths of about shaded_at_once points, ordered by step and then by path. Calls reuse its memory.
class Paths {
   public:
    Paths(const LitScene& lit, const LitOptions& options) : lit_(lit), options_(options), C_(lit.channels) {
        options_.samples = 1, options_.only = -1, options_.antithetic = false;
        lights_ = light_samples(lit, options_);
        light_of_.assign(lit.meshes.size(), -1);
        for (int k = 0; k < int(lit.lights.size()); ++k) {
            const Light& light = lit.lights[k];
            eps_ = std::max(eps_, light.eps);
            if (light.kind == Light::Kind::mesh) light_of_[light.mesh] = k;
            if (light.kind == Light::Kind::environment && environment_ < 0) environment_ = k;
        }
    }

    const std::vector<LightSample>& lights() const { return lights_; }
    const LitOptions& options() const { return options_; }

    // Traces paths from points that are `wanted`; the others get paths without points.
    template <class T, class Wanted>
    void find(const SceneView<T>& scene, const RayCaster& caster, const LitPoints& from, Wanted wanted) {
        begin(from, [&](int64_t i, Surface<double>& o) {
            if (!wanted(i)) return false;
            set_surface<double>(lit_, from.face[i], from.b + 3 * i, from.spread_at(i), o);
            return true;
        });
        extend(scene, caster, from);
    }
    // Traces paths for an image: lights are also sampled for the first points, and emitters that paths hit count. Each
    // point i starts paths_of_point paths, path(paths_of_point · i) and those after it. The first of them has the light
    // samples of the point.
    template <class T>
    void find_for_image(const SceneView<T>& scene, const RayCaster& caster, const LitPoints& from) {
        counts_emitter_hits_ = options_.shadows, paths_of_point_ = paths_of_point;
        by_paths_ =
            counts_emitter_hits_ && environment_ >= 0 && !lit_.lights[environment_].is_image ? environment_ : -1;
        find_with_light_samples(scene, caster, from, [&](int64_t i, Surface<double>& o) {
            set_surface<double>(lit_, from.face[i], from.b + 3 * i, from.spread_at(i), o);
            return true;
        });
    }
    // Traces paths from points that `place(i, surface)` sets if it returns true, and samples lights for them, too.
    template <class T, class Place>
    void find_with_light_samples(const SceneView<T>& scene, const RayCaster& caster, const LitPoints& from,
                                 Place place) {
        begin(from, place);
        sample_lights(scene, caster, from, 0);
        extend(scene, caster, from);
    }

    static bool scatters(const Surface<double>& o) { return o.mesh->has_material && !o.is_black(); }

    Path path(int64_t i) const {
        return {length_[i],
                &face_[i],
                &b_[3 * i],
                pdf_.data() + i,
                drawn_.data() + i * K(),
                seen_.data() + i * K(),
                size_t(n_),
                size_t(K()),
                counts_emitter_hits_ ? &emitter_hits_[i] : nullptr};
    }
    // Returns the surface point with which the path was traced.
    const Surface<double>& surface(int64_t i, int k) const { return surfaces_[k * n_ + i]; }

   private:
    // Holds rays from the current ends of paths.
    struct Rays {
        std::vector<int64_t> index;
        std::vector<int32_t> face, hit;
        std::vector<double> b, direction, contact, russian_roulette_probability, pdf, hit_b;

        void clear() {
            index.clear(), face.clear(), b.clear(), direction.clear(), contact.clear(),
                russian_roulette_probability.clear();
            pdf.clear();
        }
    };

    template <class Place>
    void begin(const LitPoints& from, Place place) {
        n_ = from.size * paths_of_point_;
        const int64_t all = n_ * options_.bounces;
        surfaces_.resize(all), pdf_.resize(all), face_.resize(all), b_.resize(3 * all), seed_.resize(all);
        drawn_.resize(all * lights_.size()), seen_.resize(all * lights_.size());
        length_.assign(n_, 0), throughput_.assign(n_ * C_, 1.0);
        if (counts_emitter_hits_) emitter_hits_.assign(all, {});
        for (int64_t i = 0; i < from.size; ++i) {
            const int64_t first = i * paths_of_point_;
            Surface<double>& o = surfaces_[first];
            if (!place(i, o)) continue;
            if (scatters(o)) look_up_material(lit_, o);
            for (int64_t at = first; at < first + paths_of_point_; ++at) {
                if (at > first) surfaces_[at] = o;
                face_[at] = from.face[i], std::copy(from.b + 3 * i, from.b + 3 * i + 3, &b_[3 * at]);
                length_[at] = scatters(o) ? 1 : 0;
            }
        }
    }
    // Paths from one point have consecutive indices in its sequence.
    uint64_t seed_of(const LitPoints& from, int64_t i) const {
        const uint64_t seed = uint64_t(from.seed[i / paths_of_point_]), sequence = seed >> 32 << 32;
        return sequence | uint32_t(uint32_t(seed) * uint32_t(paths_of_point_) + uint32_t(i % paths_of_point_));
    }
    template <class T>
    void extend(const SceneView<T>& scene, const RayCaster& caster, const LitPoints& from) {
        for (int k = 0; k + 1 < options_.bounces; ++k) {
            sample_bsdf(from, k);
            if (rays_.index.empty()) break;
            trace(scene, caster, k);
            sample_lights(scene, caster, from, k + 1);
        }
    }

    int64_t K() const { return int64_t(lights_.size()); }

    // Samples the directions in which paths continue after k steps, and plays Russian roulette.
    void sample_bsdf(const LitPoints& from, int k) {
        rays_.clear();
        std::optional<PathRandomNumbers> numbers;
        for (int64_t i = 0; i < n_; ++i) {
            if (length_[i] != k + 1) continue;
            const int64_t at = k * n_ + i;
            const Surface<double>& o = surfaces_[at];
            const uint64_t seed = seed_of(from, i);
            if (!numbers || !numbers->are_of(seed)) numbers.emplace(seed, k);
            const Vec2 choice = numbers->of_choice(seed);
            double russian_roulette_probability = 1;
            if (k >= steps_without_russian_roulette) {
                const double* throughput = &throughput_[i * C_];
                russian_roulette_probability =
                    std::clamp(*std::max_element(throughput, throughput + C_), least_russian_roulette_probability, 1.0);
            }
            if (counts_emitter_hits_ && o.scattering.lambertian && (k > 0 || i % paths_of_point_ == 0))
                apply_mis(at, paths_at(k) * russian_roulette_probability);
            if (choice.y >= russian_roulette_probability) continue;
            const PathSample draw(o, C_);
            const Vec3 l = draw.draw(choice.x, numbers->of_direction(seed));
            if (!(dot(o.n, l) > 0 && dot(o.g, l) > 0)) continue;
            const double size = std::max({std::fabs(o.y.x), std::fabs(o.y.y), std::fabs(o.y.z)});
            rays_.index.push_back(i), rays_.face.push_back(int32_t(face_[at]));
            rays_.b.insert(rays_.b.end(), {o.at.b[1], o.at.b[2]});
            rays_.direction.insert(rays_.direction.end(), {l.x, l.y, l.z});
            rays_.contact.push_back(16 * eps_ * size),
                rays_.russian_roulette_probability.push_back(russian_roulette_probability);
            rays_.pdf.push_back(draw.pdf(l));
        }
    }

    // Traces these rays, and extends the paths by what they hit.
    template <class T>
    void trace(const SceneView<T>& scene, const RayCaster& caster, int k) {
        rays_.hit.resize(rays_.index.size()), rays_.hit_b.resize(2 * rays_.index.size());
        trace_from_surface(scene, caster,
                           {rays_.face.data(), rays_.b.data(), rays_.direction.data(), rays_.contact.data(),
                            int64_t(rays_.index.size())},
                           rays_.hit.data(), rays_.hit_b.data());
        for (size_t r = 0; r < rays_.index.size(); ++r) {
            const int64_t i = rays_.index[r], at = (k + 1) * n_ + i;
            if (rays_.hit[r] < 0) {
                if (counts_emitter_hits_ && environment_ >= 0) add_environment_hit(r, k);
                continue;
            }
            const double u = rays_.hit_b[2 * r], v = rays_.hit_b[2 * r + 1];
            const Surface<double>& o = surfaces_[k * n_ + i];
            Surface<double>& next = surfaces_[at];
            face_[at] = rays_.hit[r], b_[3 * at] = 1 - (u + v), b_[3 * at + 1] = u, b_[3 * at + 2] = v;
            set_place<double>(lit_, face_[at], &b_[3 * at], nullptr, next);
            const Vec3 d = next.y - o.y, l = unit(d);
            const double measure = solid_angle(next, d);
            set_view(lit_, -l, next);
            if (const int light = light_of_[next.mesh - lit_.meshes.data()];
                counts_emitter_hits_ && light >= 0 && o.scattering.lambertian) {
                const double by_light = lit_.lights[light].pdf[next.at.face];
                emitter_hits_[k * n_ + i] = {light,
                                             {next.at.face, u, v, by_light + paths_at(k) * by_area(rays_, r, next, d)}};
            }
            if (!scatters(next) || !(measure > 0) || !(dot(o.n, l) > 0 && dot(o.g, l) > 0)) continue;
            pdf_[at] = rays_.pdf[r] * rays_.russian_roulette_probability[r] * measure;
            length_[i] = k + 2;
            double f[most_lit_channels];
            scatter(o.scattering, o.v, o.n, l, C_, f);
            const double weight = dot(o.n, l) / (rays_.pdf[r] * rays_.russian_roulette_probability[r]);
            for (int c = 0; c < C_; ++c) throughput_[i * C_ + c] *= std::fabs(f[c]) * weight;
        }
    }

    // Returns the number of paths whose directions share a point's light samples after k steps.
    int paths_at(int k) const { return k == 0 ? paths_of_point_ : 1; }

    // -- MIS of sampled lights and emitters that paths hit ----------------------------------------------------------

    // Converts the pdf of a direction from solid angle to area of the emitter that it hits at the displacement d.
    static double by_area(double pdf, Vec3 normal, Vec3 d) {
        const double squared = dot(d, d);
        return pdf * std::fabs(dot(normal, d)) / (squared * std::sqrt(squared));
    }
    static double by_area(const Rays& rays, size_t r, const Surface<double>& light, Vec3 d) {
        return by_area(rays.pdf[r] * rays.russian_roulette_probability[r], light.frame.g, d);
    }
    void add_environment_hit(size_t r, int k) {
        const int64_t i = rays_.index[r];
        const Surface<double>& o = surfaces_[k * n_ + i];
        if (!o.scattering.lambertian) return;
        const double* l = &rays_.direction[3 * r];
        const Light& light = lit_.lights[environment_];
        LightPoint p = point_towards(lit_.tables, light, {l[0], l[1], l[2]});
        if (light.is_image) p = above(lit_.tables, light, p, o.g);
        else p.pdf = k == 0 && by_paths_ >= 0 ? 0 : rays_.pdf[r];  // draw_constant_environment() samples by the cosine.
        p.pdf += paths_at(k) * rays_.pdf[r] * rays_.russian_roulette_probability[r];
        emitter_hits_[k * n_ + i] = {environment_, p};
    }
    // Adds the BSDF's pdf to the pdfs of light samples that a point of a path sees (balance heuristic).
    void apply_mis(int64_t at, double paths) {
        const Surface<double>& o = surfaces_[at];
        for (int64_t j = 0; j < K(); ++j) {
            const int number = lights_[j].light;
            const Light& light = lit_.lights[number];
            if (seen_[at * K() + j] <= 0 || !(number == environment_ || light.kind == Light::Kind::mesh)) continue;
            LightPoint& p = drawn_[at * K() + j];
            Vec3 l = place(lit_, light, p);
            if (number == environment_) {
                p.pdf += paths * PathSample(o, C_).pdf(l);
                continue;
            }
            const EmissiveFaces from = lit_.emitter(light);
            Vec3 corner[3];
            for (int c = 0; c < 3; ++c) corner[c] = lit_.tables[from.verts].vector_at<double>(from.vertex(p.index)[c]);
            const Vec3 d = l - o.y, normal = cross(corner[1] - corner[0], corner[2] - corner[0]);
            if (!(dot(d, d) > 0 && dot(normal, normal) > 0)) continue;
            p.pdf += by_area(paths * PathSample(o, C_).pdf(unit(d)), unit(normal), d);
        }
    }

    // Samples the lights at the points that paths have reached after k steps (next-event estimation).
    template <class T>
    void sample_lights(const SceneView<T>& scene, const RayCaster& caster, const LitPoints& from, int k) {
        const int64_t first = k * n_;
        for (int64_t i = 0; i < n_; ++i)
            seed_[first + i] =
                PathRandomNumbers::of_lights(k == 0 ? uint64_t(from.seed[i / paths_of_point_]) : seed_of(from, i), k);
        LitOptions options = options_;
        if (k == 0) options.by_paths = by_paths_;
        const LitPoints here{n_, &face_[first], &b_[3 * first], &seed_[first], {}, nullptr};
        const auto reached = [&](int64_t i) { return length_[i] == k + 1 && (k > 0 || i % paths_of_point_ == 0); };
        query_lights(lit_, scene, caster, here, options, lights_,
                     {&surfaces_[first], drawn_.data() + first * K(), seen_.data() + first * K()}, shadow_rays_,
                     reached);
        for (int64_t i = 0; i < n_; ++i)
            if (reached(i) && surfaces_[first + i].scattering.lambertian) look_up_material(lit_, surfaces_[first + i]);
    }

    const LitScene& lit_;
    LitOptions options_;
    const int C_;
    double eps_ = 0;                    // relative spacing of positions
    std::vector<int> light_of_;         // Maps meshes to their lights, −1: none.
    int environment_ = -1;              // Escaping rays hit this environment.
    bool counts_emitter_hits_ = false;  // Says whether emitters that paths hit count.
    int paths_of_point_ = 1;            // This many paths start at one point.
    int by_paths_ = -1;                 // These paths sample this light well enough alone.
    std::vector<LightSample> lights_;
    int64_t n_ = 0;  // number of paths
    // Rows hold the points of all paths after no step, one step, …, and the light samples of each.
    std::vector<Surface<double>> surfaces_;
    std::vector<double> pdf_, b_;
    std::vector<int64_t> face_, seed_;
    std::vector<LightPoint> drawn_;
    std::vector<int8_t> seen_;
    std::vector<EmitterHit> emitter_hits_;
    // For each path: the number of its points, and the throughput from its end to its beginning.
    std::vector<int> length_;
    std::vector<double> throughput_;
    Rays rays_;
    ShadowRays shadow_rays_;
};

}  // namespace edgegrad
