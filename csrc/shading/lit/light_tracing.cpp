#include "shading/lit/light_tracing.h"

#include <algorithm>
#include <cmath>

#include "rays/trace.h"
#include "shading/lit/lit.h"
#include "shading/lit/path.h"
#include "shading/lit/path_sampling.h"

namespace edgegrad {

namespace {

double size_of(Vec3 y) { return std::max({std::fabs(y.x), std::fabs(y.y), std::fabs(y.z)}); }

// Traces a few arrivals on one thread.
template <class T>
class LightPaths {
   public:
    LightPaths(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const CameraConnections& camera)
        : lit_(lit), scene_(scene), caster_(caster), camera_(camera), C_(lit.channels) {
        for (const Light& light : lit.lights) eps_ = std::max(eps_, light.eps);
        filtered_ = lit.is_filtered();
    }

    void trace(const Arrivals& arrivals, int64_t first_arrival, StepRange steps, Connections& out) {
        vertices_.clear();
        for (int64_t i = 0; i < arrivals.size; ++i) {
            const double *in = arrivals.from + 3 * i, *carried = arrivals.carried + C_ * i;
            if (std::all_of(carried, carried + C_, [](double x) { return x == 0; })) continue;
            PathVertex vertex;
            vertex.arrival = first_arrival + i, vertex.seed = arrivals.seed[i], vertex.throughput = 1;
            vertex.in = {in[0], in[1], in[2]};
            std::copy(carried, carried + C_, vertex.carried);
            if (place(arrivals.face[i], arrivals.b + 3 * i, vertex)) vertices_.push_back(vertex);
        }
        for (int k = 0; k <= steps.last && !vertices_.empty(); ++k) {
            if (k >= steps.first) connect(out);
            if (k < steps.last) extend(k);
        }
    }

   private:
    // Holds the current vertex of a path.
    struct PathVertex {
        int64_t arrival, seed;
        double throughput;  // throughput up to this vertex, in its largest channel
        Vec3 in;
        double carried[most_lit_channels];  // B t (n · in) / |g · in| once the vertex is placed
        Surface<double> o;
        int64_t face;
    };

    // Returns false where the side that faces the light scatters none.
    bool place(int64_t face, const double* b, PathVertex& vertex) const {
        Surface<double>& o = vertex.o;
        vertex.face = face;
        set_place<double>(lit_, face, b, nullptr, o);
        set_view(lit_, vertex.in, o);
        if (!o.mesh->has_material || o.is_black()) return false;
        const double cosine = dot(o.n, vertex.in), of_face = dot(o.g, vertex.in);
        if (!(cosine > 0 && of_face > 0)) return false;
        look_up_material(lit_, o);
        double factor = cosine / of_face;
        if (!o.mesh->normal.is_flat()) factor *= terminator<double>(o.g, o.n, vertex.in);
        else factor = 1;
        for (int c = 0; c < C_; ++c) vertex.carried[c] *= factor;
        vertex.throughput *= factor;
        return true;
    }

    // Writes the BSDF for light from one unit direction into another. Returns false if nothing is scattered.
    bool scatters(const Surface<double>& o, Vec3 into, Vec3 from, double* f) const {
        if (!(dot(o.n, into) > 0 && dot(o.g, into) > 0)) return false;
        scatter(o.scattering, into, o.n, from, C_, f);
        return true;
    }

    void connect(Connections& out) {
        lines_.clear();
        const Vec3 eye = lit_.tables[lit_.eye].vector_at<double>(0);
        for (size_t e = 0; e < vertices_.size(); ++e) {
            const PathVertex& vertex = vertices_[e];
            const Surface<double>& o = vertex.o;
            const Vec3 v = lit_.perspective ? unit(eye - o.y) : eye;
            double f[most_lit_channels];
            if (!scatters(vertex.o, v, vertex.in, f)) continue;
            const Vec3* corner = o.frame.corner;
            camera_.each(o.y, corner[1] - corner[0], corner[2] - corner[0], [&](CameraConnection there) {
                const Vec3 to = lit_.perspective ? eye : o.y + (length(o.y - lit_.center) + 1.01 * lit_.radius) * v;
                lines_.face.push_back(int32_t(vertex.face));
                lines_.b.insert(lines_.b.end(), {o.at.b[1], o.at.b[2]});
                lines_.to.insert(lines_.to.end(), {to.x, to.y, to.z});
                lines_.contact.push_back(16 * eps_ * std::max(size_of(o.y), size_of(to)));
                lines_.arrival.push_back(vertex.arrival), lines_.x.push_back(there.x);
                if (filtered_) {
                    Surface<double> seen = o;
                    seen.at.spread = there.spread;
                    look_up_material(lit_, seen);
                    scatters(seen, v, vertex.in, f);
                }
                for (int c = 0; c < C_; ++c) lines_.radiance.push_back(f[c] * vertex.carried[c] * there.area_scale);
            });
        }
        const size_t n = lines_.face.size();
        lines_.seen.resize(n);
        test_visibility(scene_, caster_,
                        {lines_.face.data(), lines_.b.data(), lines_.to.data(), lines_.contact.data(), int64_t(n)},
                        lines_.seen.data());
        for (size_t k = 0; k < n; ++k) {
            if (!lines_.seen[k]) continue;
            out.arrival.push_back(lines_.arrival[k]);
            out.x.insert(out.x.end(), {lines_.x[k].x, lines_.x[k].y});
            const auto radiance = lines_.radiance.begin() + int64_t(k) * C_;
            out.radiance.insert(out.radiance.end(), radiance, radiance + C_);
        }
    }

    // Extends all paths by step k, and plays Russian roulette.
    void extend(int k) {
        extended_.clear(), rays_.clear();
        for (const PathVertex& vertex : vertices_) {
            const uint64_t seed = uint64_t(vertex.seed);
            const PathRandomNumbers numbers(seed, k);
            const Vec2 choice = numbers.of_choice(seed);
            double russian_roulette_probability = 1;
            if (k >= steps_without_russian_roulette) {
                russian_roulette_probability = std::clamp(vertex.throughput, least_russian_roulette_probability, 1.0);
                if (choice.y >= russian_roulette_probability) continue;
            }
            const Surface<double>& o = vertex.o;
            const PathSample draw(o, C_);
            const Vec3 w = draw.draw(choice.x, numbers.of_direction(seed));
            double f[most_lit_channels];
            if (!scatters(o, w, vertex.in, f)) continue;
            const double weight = dot(o.g, w) / (draw.pdf(w) * russian_roulette_probability);
            if (!std::isfinite(weight)) continue;
            PathVertex& next = extended_.emplace_back(vertex);
            for (int c = 0; c < C_; ++c) f[c] *= weight, next.carried[c] *= f[c], f[c] = std::fabs(f[c]);
            next.throughput *= *std::max_element(f, f + C_), next.in = -w;
            rays_.face.push_back(int32_t(vertex.face)), rays_.b.insert(rays_.b.end(), {o.at.b[1], o.at.b[2]});
            rays_.direction.insert(rays_.direction.end(), {w.x, w.y, w.z});
            rays_.contact.push_back(16 * eps_ * size_of(o.y));
        }
        const size_t n = extended_.size();
        rays_.hit.resize(n), rays_.hit_b.resize(2 * n);
        trace_from_surface(
            scene_, caster_,
            {rays_.face.data(), rays_.b.data(), rays_.direction.data(), rays_.contact.data(), int64_t(n)},
            rays_.hit.data(), rays_.hit_b.data());
        vertices_.clear();
        for (size_t r = 0; r < n; ++r) {
            if (rays_.hit[r] < 0) continue;
            const double u = rays_.hit_b[2 * r], v = rays_.hit_b[2 * r + 1], b[3] = {1 - (u + v), u, v};
            PathVertex& vertex = extended_[r];
            if (place(rays_.hit[r], b, vertex)) vertices_.push_back(vertex);
        }
    }

    const LitScene& lit_;
    const SceneView<T>& scene_;
    const RayCaster& caster_;
    const CameraConnections& camera_;
    const int C_;
    double eps_ = 0;  // relative spacing of positions
    bool filtered_ = false;
    std::vector<PathVertex> vertices_, extended_;
    struct {
        std::vector<int32_t> face, hit;
        std::vector<double> b, direction, contact, hit_b;
        void clear() { face.clear(), b.clear(), direction.clear(), contact.clear(); }
    } rays_;
    struct {
        std::vector<int32_t> face;
        std::vector<double> b, to, contact, radiance;
        std::vector<int64_t> arrival;
        std::vector<Vec2> x;
        std::vector<uint8_t> seen;
        void clear() {
            face.clear(), b.clear(), to.clear(), contact.clear(), radiance.clear(), arrival.clear(), x.clear();
        }
    } lines_;
};

}  // namespace

template <class T>
std::vector<Connections> towards_camera(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                                        const CameraConnections& camera, const Arrivals& arrivals, StepRange steps,
                                        ThreadTeam& team) {
    const int64_t blocks = (arrivals.size + shaded_at_once - 1) / shaded_at_once;
    std::vector<Connections> out(blocks);
    team.parallel_for_with_state(
        blocks, [&] { return std::make_shared<LightPaths<T>>(lit, scene, caster, camera); },
        [&](LightPaths<T>& paths, int64_t block) {
            team.check();
            const int64_t first = block * shaded_at_once;
            paths.trace(arrivals.part(first, shaded_at_once, lit.channels), first, steps, out[block]);
        });
    return out;
}

template std::vector<Connections> towards_camera(const LitScene&, const SceneView<float>&, const RayCaster&,
                                                 const CameraConnections&, const Arrivals&, StepRange, ThreadTeam&);
template std::vector<Connections> towards_camera(const LitScene&, const SceneView<double>&, const RayCaster&,
                                                 const CameraConnections&, const Arrivals&, StepRange, ThreadTeam&);

}  // namespace edgegrad
