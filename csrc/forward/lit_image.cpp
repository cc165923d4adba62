#include "forward/lit_image.h"

#include <algorithm>
#include <atomic>
#include <memory>

#include "forward/pixel_hits.h"

namespace edgegrad {

namespace {

constexpr int most_again = 8;   // times the points of a face in a pixel, where it is shaded again
constexpr int share_again = 4;  // times the points of the first pass, in all

// What is seen of punctual lamps in the pixels of an image, and how many points were shaded there.
class LampVisibility {
   public:
    LampVisibility(int width, int height, const std::vector<LightSample>& lights, const LitScene& lit)
        : width_(width), height_(height), points_(int64_t(width) * height, 0) {
        for (size_t k = 0; k < lights.size(); ++k)
            if (lit.lamps[lights[k].lamp].is_punctual()) columns_.push_back(k);
        seen_.assign(size_t(width + 2) * (height + 2) * columns_.size(), 0);
    }

    // Of one point.
    void add(int x, int y, const int8_t* seen) {
        ++points_[int64_t(y) * width_ + x];
        uint8_t* here = seen_.data() + at(x, y);
        for (size_t l = 0; l < columns_.size(); ++l)
            if (const int8_t s = seen[columns_[l]]; s != not_asked) here[l] |= s ? visible : hidden;
    }

    // Pixels that borders run through, and how many times as many points of each face in them are to be shaded.
    int borders(std::vector<uint8_t>& pixels, Team& team) const {
        pixels.assign(points_.size(), 0);
        if (columns_.empty()) return 0;
        team.each(height_, [&](int64_t y) { mark(int(y), &pixels[y * width_]); });
        int64_t first = 0, there = 0;
        for (size_t i = 0; i < pixels.size(); ++i) first += points_[i], there += pixels[i] ? points_[i] : 0;
        if (std::none_of(pixels.begin(), pixels.end(), [](uint8_t p) { return p != 0; })) return 0;
        return int(std::clamp<int64_t>(share_again * first / std::max<int64_t>(there, 1), 2, most_again));
    }

   private:
    enum : uint8_t { hidden = 1, visible = 2 };

    // With a pixel around the image, of which nothing is known.
    size_t at(int x, int y) const { return (size_t(y + 1) * (width_ + 2) + x + 1) * columns_.size(); }
    void mark(int y, uint8_t* pixels) const {
        const size_t L = columns_.size(), n = L * width_;
        const uint8_t *above = seen_.data() + at(0, y - 1), *row = seen_.data() + at(0, y),
                      *below = seen_.data() + at(0, y + 1);
        std::vector<uint8_t> both(n);
        for (size_t e = 0; e < n; ++e)
            both[e] = (above + e)[-ptrdiff_t(L)] | above[e] | above[e + L] | (row + e)[-ptrdiff_t(L)] | row[e + L] |
                      (below + e)[-ptrdiff_t(L)] | below[e] | below[e + L];
        for (size_t e = 0; e < n; ++e)
            if (both[e] == (hidden | visible)) pixels[e / L] = 1;
    }

    int width_, height_;
    std::vector<int32_t> points_;
    std::vector<size_t> columns_;  // of light samples, those of punctual lamps
    std::vector<uint8_t> seen_;    // (H + 2, W + 2, those)
};

// What rows have in common.
template <class T>
struct RowInput {
    const LitScene& lit;
    const SceneView<T>& scene;
    const RayCaster& caster;
    const LitOptions& options;
    int width, points;
    uint64_t seed;
    const uint8_t* only;  // pixels, null: all
    LitImage<T>& to;
    LampVisibility* visibility;  // null: not wanted
    Team& team;
};

template <class T>
class LitRow : public RowVisitor {
   public:
    explicit LitRow(const RowInput<T>& in)
        : in_(in),
          lights_(light_samples(in.lit, in.options)),
          buffers_(shade_buffers(in.lit, in.options)),
          sums_(int64_t(in.width) * in.lit.channels) {}

    void visit(int y, std::vector<PixelHit>& hits) override {
        std::fill(sums_.begin(), sums_.end(), 0.0);
        among_ = 0;
        for (size_t first = 0; first < hits.size(); first += shaded_at_once) {
            in_.team.check();  // with many points of lights a row takes long
            shade(hits, first, std::min(hits.size() - first, size_t(shaded_at_once)));
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
        face_.clear(), b_.clear(), seed_.clear(), radiance_.resize(n * C), seen_.resize(n * K);
        for (size_t i = first; i < first + n; ++i) {
            const PixelHit& hit = hits[i];
            among_ = i > 0 && hits[i - 1].pixel == hit.pixel ? among_ + 1 : 0;
            face_.push_back(hit.face), b_.insert(b_.end(), {1 - (hit.b.u + hit.b.v), hit.b.u, hit.b.v});
            seed_.push_back(int64_t(in_.seed + uint64_t(in_.points) * uint64_t(hit.pixel) + among_));
        }
        shade_some(in_.lit, in_.scene, in_.caster, {int64_t(n), face_.data(), b_.data(), seed_.data(), {}}, in_.options,
                   *buffers_, radiance_.data(), seen_.data());
        for (size_t i = 0; i < n; ++i) {
            const PixelHit& hit = hits[first + i];
            double* sum = &sums_[int64_t(hit.pixel % in_.width) * C];
            for (int c = 0; c < C; ++c) sum[c] += hit.weight * radiance_[i * C + c];
            const int8_t* seen = seen_.data() + i * K;
            if (in_.visibility) in_.visibility->add(hit.pixel % in_.width, hit.pixel / in_.width, seen);
            for (size_t k = 0; k < K; ++k)
                if (seen[k] != not_asked)
                    std::atomic_ref(in_.to.asked[lights_[k].lamp]).store(1, std::memory_order_relaxed);
        }
    }

    const RowInput<T>& in_;
    std::vector<LightSample> lights_;
    std::shared_ptr<ShadeBuffers> buffers_;
    std::vector<double> sums_;  // of the row
    uint64_t among_ = 0;        // the hits of one pixel, which this is
    std::vector<int64_t> face_, seed_;
    std::vector<double> b_, radiance_;
    std::vector<int8_t> seen_;
};

}  // namespace

template <class T>
LitImage<T> render_lit(const LitScene& lit, const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                       const ImageOptions& image, const LitOptions& options, const LitSampling& sampling, Team& team,
                       const HitBuffers<T>& hits) {
    LitImage<T> out{Array<T>(int64_t(camera.width) * camera.height * lit.channels),
                    std::vector<uint8_t>(lit.lamps.size(), 0)};
    const bool twice = options.shadows && image.spp > 1;
    std::unique_ptr<LampVisibility> visibility;
    if (twice)
        visibility = std::make_unique<LampVisibility>(camera.width, camera.height, light_samples(lit, options), lit);
    const auto shade_pixels = [&](const PixelChoice& choice, uint64_t seed) {
        const RowInput<T> rows{lit,         scene, caster,      options, camera.width,
                               choice.most, seed,  choice.only, out,     choice.only ? nullptr : visibility.get(),
                               team};
        visit_pixel_hits(scene, camera, caster, image, choice, team, hits,
                         [&] { return std::make_unique<LitRow<T>>(rows); });
    };
    shade_pixels({0, camera.height, sampling.points}, sampling.seed);
    if (!twice) return out;
    std::vector<uint8_t> borders;
    if (const int times = visibility->borders(borders, team))
        shade_pixels({0, camera.height, times * sampling.points, borders.data()}, sampling.again);
    return out;
}

template LitImage<float> render_lit(const LitScene&, const SceneView<float>&, const Camera&, const RayCaster&,
                                    const ImageOptions&, const LitOptions&, const LitSampling&, Team&,
                                    const HitBuffers<float>&);
template LitImage<double> render_lit(const LitScene&, const SceneView<double>&, const Camera&, const RayCaster&,
                                     const ImageOptions&, const LitOptions&, const LitSampling&, Team&,
                                     const HitBuffers<double>&);

}  // namespace edgegrad
