// This file draws samples on shadow boundaries.
//
// Pieces of edges before parts of the light (shadow_edges.h) lie end to end by an estimate of their shadows that needs
// no ray. Equal intervals of that measure get some pilots each: rays from the light past the edge to a face, and from
// the camera to there. Pilots measure the length of the boundary's image, its motion with the edge, and the light that
// ends there. The density of samples follows the root mean square of that product over an interval, with a lower bound.

#include "secondary/shadows.h"

#include <algorithm>
#include <cmath>

#include "secondary/estimator.h"
#include "secondary/shadow_samples.h"
#include "secondary/shadow_source.h"

namespace edgegrad {

namespace {

// Returns what a visible pilot finds: the image area that the boundary sweeps as the edge moves, times the light there.
// Where light grazes a face, that area is large for little length.
template <class T>
ShadowPilot pilot_at(const BackwardView<T>& view, const LightParts& light, const ShadowSource<T>& source,
                     const typename ShadowSource<T>::Sample& sample) {
    const ShadowPoint& point = sample.curve;
    const Vec3 y = source.place_of(point), m = sample.m, from = source.light_of(point);
    const Vec3 d = light.infinite ? from : from - y;
    const double cosine = std::fabs(dot(m, d)) / (length(m) * length(d));
    Vec3 there;
    for (int i = 0; i < 3; ++i) there += point.on[i] * corner(view.scene, point.face, i);
    const double arriving = cosine * light.towards(point.part, point.light, there);
    const double look = view.importance.mean(sample.x, sample.x);
    const double swept = sample.border.swept(std::fabs(sample.weight * sample.scale * sample.area_scale), point.caster);
    const double px = sample.weight * sample.speed * std::sqrt(std::fabs(sample.area_scale));
    return {swept * arriving * look, look > 0 ? px : 0};
}

}  // namespace

template <class T>
void add_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, int64_t samples,
                 const Record& record, GradientSink& to) {
    // A light with an extent gets all samples, because each of its points casts its own shadow.
    const int64_t most = default_secondary_samples(view);
    ShadowSampler<T> sampler(
        view, casters, light,
        {.pilots = Stream::shadow_pilots, .places = Stream::shadow_places, .rays = Stream::shadow_rays},
        samples >= 0     ? samples
        : light.extended ? most
                         : 0);
    const CurvesInView receiver(
        view, ShadowSource<T>(view, light.infinite), record,
        [&](const auto& source, const auto& sample) { return pilot_at(view, light, source, sample); });
    const auto number = [&] {
        if (samples >= 0) return samples;
        const double along = shadow_samples_a_pixel * sample_growth(view.image.spp) * sampler.length();
        const int64_t wanted = light.extended ? most : int64_t(std::min(along, 1e15));
        return std::clamp(wanted, fewest_secondary_samples(view.image.spp), most);
    };
    record_secondary(view, sampler, receiver, number, to);
}

template void add_shadows(const BackwardView<float>&, const SceneView<float>&, const LightParts&, int64_t,
                          const Record&, GradientSink&);
template void add_shadows(const BackwardView<double>&, const SceneView<double>&, const LightParts&, int64_t,
                          const Record&, GradientSink&);

}  // namespace edgegrad
