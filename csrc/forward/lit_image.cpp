#include "forward/lit_image.h"

#include <algorithm>
#include <atomic>
#include <memory>
#include <optional>

#include "core/sobol.h"
#include "forward/discontinuous_pixels.h"
#include "forward/environment_guide.h"
#include "forward/pixel_hits.h"
#include "shading/lit/indirect.h"

namespace edgegrad {

namespace {

// Holds what rows share.
template <class T>
struct RowInput {
    const LitScene& lit;
    const SceneView<T>& scene;
    const RayCaster& caster;
    const LitOptions& options;
    int width, points;
    uint64_t seed;
    const uint8_t* only;  // selects pixels; null: all
    LitImage<T>& to;
    DiscontinuousPixels* discontinuous;  // Null means not wanted.
    EnvironmentGuide* guide;             // Null means not wanted.
    ThreadTeam& team;
};

template <class T>
class LitRow : public RowVisitor {
   public:
    explicit LitRow(const RowInput<T>& in)
        : in_(in),
          lights_(light_samples(in.lit, in.options)),
          buffers_(shade_buffers(in.lit, in.options)),
          paths_(in.options.bounces > 1 ? path_buffers(in.lit, in.options) : nullptr),
          sums_(int64_t(in.width) * in.lit.channels),
          filtered_(in.lit.is_filtered()) {}

    void visit(int y, std::vector<PixelHit>& hits) override {
        std::fill(sums_.begin(), sums_.end(), 0.0);
        among_ = 0;
        const size_t at_once = paths_ ? shaded_at_once / paths_of_point : shaded_at_once;
        for (size_t first = 0; first < hits.size(); first += at_once) {
            in_.team.check();  // A row with many points of lights takes long.
            shade(hits, first, std::min(hits.size() - first, at_once));
        }
        const int C = in_.lit.channels;
        for (int x = 0; x < in_.width; ++x) {
            const int64_t pixel = int64_t(y) * in_.width + x;
            if (in_.only && !in_.only[pixel]) continue;
            for (int c = 0; c < C; ++c) in_.to.radiance[pixel * C + c] = T(sums_[int64_t(x) * C + c]);
        }
    }

   private:
    void shade(const std::vector<PixelHit>& hits, size_t first, size_t n) {
        const int C = in_.lit.channels;
        const size_t K = lights_.size();
        face_.clear(), b_.clear(), seed_.clear(), spread_.clear(), radiance_.resize(n * C), seen_.resize(n * K);
        for (size_t i = first; i < first + n; ++i) {
            const PixelHit& hit = hits[i];
            among_ = i > 0 && hits[i - 1].pixel == hit.pixel ? among_ + 1 : 0;
            face_.push_back(hit.face), b_.insert(b_.end(), {1 - (hit.b.u + hit.b.v), hit.b.u, hit.b.v});
            if (filtered_)
                for (const Barycentrics& next : {hit.spread.right, hit.spread.down})
                    spread_.insert(spread_.end(), {next.u, next.v});
            const uint64_t place = z_order(uint32_t(hit.pixel % in_.width), uint32_t(hit.pixel / in_.width));
            seed_.push_back(int64_t(in_.seed + uint64_t(in_.points) * place + among_));
        }
        const double* spread = filtered_ ? spread_.data() : nullptr;
        const LitPoints points{int64_t(n), face_.data(), b_.data(), seed_.data(), {}, spread};
        if (paths_ && in_.options.samples == 1) {
            shade_by_paths(in_.lit, in_.scene, in_.caster, points, *paths_, radiance_.data(), seen_.data());
            if (in_.guide) in_.guide->add(*paths_, paths_of_point * int64_t(n));
        } else {
            shade_some(in_.lit, in_.scene, in_.caster, points, in_.options, *buffers_, radiance_.data(), seen_.data());
            if (paths_) add_indirect(in_.lit, in_.scene, in_.caster, points, *paths_, radiance_.data());
        }
        for (size_t i = 0; i < n; ++i) {
            const PixelHit& hit = hits[first + i];
            double* sum = &sums_[int64_t(hit.pixel % in_.width) * C];
            for (int c = 0; c < C; ++c) sum[c] += hit.weight * radiance_[i * C + c];
            const int8_t* seen = seen_.data() + i * K;
            if (in_.discontinuous) in_.discontinuous->add(hit.pixel, hit.face, &b_[3 * i], seen);
            for (size_t k = 0; k < K; ++k)
                if (seen[k] != not_sampled)
                    std::atomic_ref(in_.to.shadow_needed[lights_[k].light]).store(1, std::memory_order_relaxed);
        }
    }

    const RowInput<T>& in_;
    std::vector<LightSample> lights_;
    std::shared_ptr<ShadeBuffers> buffers_;
    std::shared_ptr<Paths> paths_;  // Null means direct light alone.
    std::vector<double> sums_;      // sums of the row
    bool filtered_;
    uint64_t among_ = 0;  // index of the current hit among those of its pixel
    std::vector<int64_t> face_, seed_;
    std::vector<double> b_, spread_, radiance_;
    std::vector<int8_t> seen_;
};

constexpr uint64_t pilot_stream = 0x70696c6f74;  // separates the pilot's random numbers

// Selects every second pixel of every second row, or fewer in large images.
std::vector<uint8_t> sparse_pixels(const Camera& camera) {
    constexpr double pilot_pixels = 4096;
    const int step = std::max(2, int(std::sqrt(double(camera.width) * camera.height / pilot_pixels)));
    std::vector<uint8_t> out(size_t(camera.width) * camera.height, 0);
    for (int y = step / 2; y < camera.height; y += step)
        for (int x = step / 2; x < camera.width; x += step) out[size_t(y) * camera.width + x] = 1;
    return out;
}

}  // namespace

template <class T>
LitImage<T> render_lit(const LitScene& given, const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                       const ImageOptions& image, const LitOptions& options, const LitSampling& sampling,
                       ThreadTeam& team, const HitBuffers<T>& hits) {
    LitImage<T> out{Array<T>(int64_t(camera.width) * camera.height * given.channels),
                    std::vector<uint8_t>(given.lights.size(), 0)};
    std::unique_ptr<DiscontinuousPixels> discontinuous;
    if (image.spp > 1)
        discontinuous = std::make_unique<DiscontinuousPixels>(camera.width, camera.height, given, options);
    const auto shade_pixels = [&](const LitScene& lit, const ImageOptions& image, const PixelChoice& choice,
                                  uint64_t seed, EnvironmentGuide* guide = nullptr) {
        const RowInput<T> rows{lit,         scene, caster,      options, camera.width,
                               choice.most, seed,  choice.only, out,     choice.only ? nullptr : discontinuous.get(),
                               guide,       team};
        visit_pixel_hits(scene, camera, caster, image, choice, team, hits,
                         [&] { return std::make_unique<LitRow<T>>(rows); });
    };
    const bool spread = given.is_filtered();
    EnvironmentGuide guide(given);
    const bool guides = options.bounces > 1 && options.samples == 1 && options.shadows && guide.has_environment();
    if (guides) {
        // The pilot's random numbers differ from the image's, or its results would correlate with the guided samples.
        const std::vector<uint8_t> pixels = sparse_pixels(camera);
        const ImageOptions few{1, image.filter, hash(image.seed, pilot_stream)};
        shade_pixels(given, few, {0, camera.height, 1, pixels.data(), spread}, hash(sampling.again, pilot_stream),
                     &guide);
    }
    const std::optional<LitScene> guided = guides ? std::optional(guide.guided()) : std::nullopt;
    const LitScene& lit = guided ? *guided : given;
    shade_pixels(lit, image, {0, camera.height, sampling.points, nullptr, spread}, sampling.seed);
    if (!discontinuous) return out;
    std::vector<uint8_t> pixels;
    ImageOptions finer = image;
    if (options.bounces > 1) finer.spp *= rays_again;
    if (const int times = discontinuous->find(pixels, team))
        shade_pixels(lit, finer, {0, camera.height, times * sampling.points, pixels.data(), spread}, sampling.again);
    return out;
}

template LitImage<float> render_lit(const LitScene&, const SceneView<float>&, const Camera&, const RayCaster&,
                                    const ImageOptions&, const LitOptions&, const LitSampling&, ThreadTeam&,
                                    const HitBuffers<float>&);
template LitImage<double> render_lit(const LitScene&, const SceneView<double>&, const Camera&, const RayCaster&,
                                     const ImageOptions&, const LitOptions&, const LitSampling&, ThreadTeam&,
                                     const HitBuffers<double>&);

}  // namespace edgegrad
