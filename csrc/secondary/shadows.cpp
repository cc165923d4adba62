// This file draws samples on shadow boundaries.
//
// Pieces of edges before parts of the light (shadow_edges.h) lie end to end by an estimate of their shadows that needs
// no ray. Equal intervals of that measure get some pilots each: rays from the light past the edge to a face, and from
// the camera to there. Pilots measure the length of the boundary's image, its motion with the edge, and the light that
// ends there. The density of samples follows the root mean square of that product over an interval, with a lower bound.

#include "secondary/shadows.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "boundary/accumulation.h"
#include "boundary/curve_samples.h"
#include "secondary/shadow_samples.h"
#include "secondary/shadow_source.h"

namespace edgegrad {

namespace {

constexpr double samples_a_pixel = 24;  // samples per pixel of a point light's shadow boundary

// Pilots accumulates the results of pilots.
template <class T>
class Pilots {
   public:
    Pilots(const BackwardView<T>& view, const LightParts& light, std::vector<ShadowStatistics>& found)
        : view_(view), light_(light), found_(found) {}

    bool wants(int, Vec2) const { return true; }

    void add(int, ShadowSource<T>& source, typename ShadowSource<T>::Sample& sample) {
        const ShadowPoint& point = sample.shadow;
        const Vec3 y = source.place_of(point), m = sample.m, light = source.light_of(point);
        const Vec3 d = light_.infinite ? light : light - y;
        const double cosine = std::fabs(dot(m, d)) / (length(m) * length(d));
        Vec3 there;
        for (int i = 0; i < 3; ++i) there += point.on[i] * corner(view_.scene, point.face, i);
        const double arriving = cosine * light_.towards(point.part, point.light, there);
        const double look = view_.importance.mean(sample.x, sample.x);
        // The boundary sweeps this area as the edge moves. Where light grazes a face, it is large for little length.
        const double swept =
            sample.border.swept(std::fabs(sample.weight * sample.scale * sample.area_scale), point.caster);
        const double px = sample.weight * sample.speed * std::sqrt(std::fabs(sample.area_scale));
        const double value = swept * arriving * look;
        if (!std::isfinite(value)) return;
        found_[point.segment].squares += value * value, found_[point.segment].length += look > 0 ? px : 0;
    }

   private:
    const BackwardView<T>& view_;
    const LightParts& light_;
    std::vector<ShadowStatistics>& found_;
};

}  // namespace

int64_t most_shadow_samples(int64_t width, int64_t height, int spp) {
    return std::clamp(width * height * spp / 8, fewest_samples, most_samples);
}

template <class T>
void add_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, int64_t samples,
                 const Record& record, GradientSink& to, BackwardProfile& profile) {
    // A sample casts an incoherent ray from the light and one from the camera, so rays are limited to an eighth of the
    // image's. A light with an extent gets all of them, because each of its points casts its own shadow.
    const int64_t most = most_shadow_samples(view.camera.width, view.camera.height, view.image.spp);
    const ShadowCasters<T> edges(view, casters, light, samples >= 0 ? samples : light.extended ? most : 0);
    if (edges.empty()) return;
    // Casts from the camera to the points that light has met.
    const auto chunk_of = [&](uint64_t seed, ShadowSource<T>& source, auto& samples_of_chunk) {
        return ShadowChunk(edges.scene(), seed, [&](const ShadowPoint& point, double weight) {
            if (is_in_view(view, source.place_of(point))) samples_of_chunk.add(point, 0, weight);
        });
    };

    std::vector<ShadowStatistics> of_interval(edges.intervals());
    const uint64_t pilot_seed = hash(view.options.seed, 10, gradient_stream);
    edges.draw_pilots(pilot_seed, [&](auto ask) {
        LocalGradients unused;
        Pilots pilots_of_block(view, light, of_interval);
        ShadowSource<T> source(view, light.infinite);
        CurveSamples samples_of_block(view, source, pilots_of_block);
        auto chunk = chunk_of(mix(pilot_seed), source, samples_of_block);
        ask(chunk);
        samples_of_block.finish(unused);
    });
    double length = 0;  // length of the boundary, px, averaged over the light
    for (const ShadowStatistics& found : of_interval) length += found.length / double(pilots * edges.intervals());
    Array<double> density = density_of(of_interval);
    const int64_t wanted = light.extended ? most : int64_t(std::min(samples_a_pixel * length, 1e15));
    const int64_t n = samples >= 0 ? samples : std::clamp(wanted, fewest_samples, most);
    profile.shadow_samples += n;
    if (view.options.dry || n == 0) return;
    const int64_t samples_of_place = light.extended ? mirrored : 1,
                  places = (n + samples_of_place - 1) / samples_of_place;
    const Places drawn(edges.scene().pieces, density, places, light.extended,
                       hash(view.options.seed, 11, gradient_stream), view.team);
    double seconds[2] = {};
    view.scatter.add(places, to, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
        const std::unique_ptr<CurveAccumulation> to_chunk = accumulate_curves(view, record, grad);
        ShadowSource<T> source(view, light.infinite);
        CurveSamples samples_of_chunk(view, source, *to_chunk);
        auto chunk = chunk_of(hash(view.options.seed, 9, gradient_stream), source, samples_of_chunk);
        Places place(drawn);
        for (int64_t i = first; i < last; ++i) {
            const auto [position, interval, weight] = place(i);
            chunk.add(i, position, interval, weight, samples_of_place);
        }
        chunk.cast();
        samples_of_chunk.finish(grad);
    });
}

template void add_shadows(const BackwardView<float>&, const SceneView<float>&, const LightParts&, int64_t,
                          const Record&, GradientSink&, BackwardProfile&);
template void add_shadows(const BackwardView<double>&, const SceneView<double>&, const LightParts&, int64_t,
                          const Record&, GradientSink&, BackwardProfile&);

}  // namespace edgegrad
