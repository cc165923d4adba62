#include "backward/terms.h"

#include <numeric>
#include <optional>
#include <vector>

#include "boundary/curve.h"
#include "discontinuities/discontinuities.h"
#include "estimator/vertex_image.h"
#include "interior/interior.h"
#include "interior/surface_measure.h"
#include "primary/curve_measure.h"
#include "primary/primary_curves.h"

namespace edgegrad {

namespace {

// TermMeasures holds where the terms sample, and how often.
template <class T>
struct TermMeasures {
    std::optional<SurfaceMeasure<T>> surface;
    std::optional<Curves<T>> curves;
    SampleCounts wanted;
};

template <class T>
TermMeasures<T> measure_terms(const BackwardView<T>& view, const Terms& terms, GradientSink& to,
                              BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    Stopwatch watch;
    TermMeasures<T> out;
    Array<int8_t> facing(terms.boundary ? view.scene.n_faces : 0);
    if (terms.interior()) {
        out.surface.emplace(measure_surface(view, terms.motion, facing, to));
        out.wanted.surface = out.surface->wanted(o.surface_samples);
        profile.surface_wanted = out.surface->pixel_samples() + out.wanted.surface;
        profile.measure = watch.lap();
    }
    if (terms.boundary) {
        if (!terms.interior()) facing = facing_of_faces(view);
        const Curves<T>& curves = out.curves.emplace(measure_curves(view, std::move(facing), terms.lens_boundary));
        out.wanted.edge = profile.edge_wanted = curves.wanted(o, view.image.spp);
        profile.silhouettes = curves.silhouettes, profile.creases = curves.creases;
        profile.intersections = curves.intersections, profile.lens_boundary = curves.lens_boundary;
        profile.curves = watch.lap();
    }
    return out;
}

}  // namespace

template <class T>
SampleCounts wanted_samples(const BackwardView<T>& view, const Terms& terms) {
    GradientSink none;
    BackwardProfile profile;
    measure_terms(view, terms, none, profile);
    return {profile.surface_wanted, profile.edge_wanted};
}

template <class T>
SampleCounts within_budget(const BackwardInput<T>& input, const GradientOptions& o, SampleCounts wanted,
                           ThreadTeam& team) {
    const int64_t pixels = int64_t(input.camera.width) * input.camera.height;
    const SampleBudget budget(input.hits.coverage, pixels, input.image.spp, o, team);
    SampleCounts n = budget.share(wanted);
    if (o.surface_samples >= 0) n.surface = wanted.surface;
    if (o.edge_samples >= 0) n.edge = wanted.edge;
    return n;
}

template <class T>
void add_terms(const BackwardInput<T>& input, const BackwardView<T>& view, const Terms& terms,
               const Accumulation& accumulation, GradientSink& to, BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    if (o.pixel_spp) {
        std::vector<int64_t> all(int64_t(view.camera.width) * view.camera.height);
        std::iota(all.begin(), all.end(), 0);
        add_pixel_samples(view, {all, o.pixel_spp, o.seed, nullptr}, accumulation, to, profile.surface);
        return;
    }
    // Both terms are measured before samples are drawn, since they share a budget.
    TermMeasures<T> measured = measure_terms(view, terms, to, profile);
    const SampleCounts n = within_budget(input, o, measured.wanted, view.team);
    if (measured.surface) add_interior(view, *measured.surface, n.surface, accumulation, to, profile);
    if (Curves<T>* curves = measured.curves ? &*measured.curves : nullptr) {
        add_boundary(view, *curves, n.edge, accumulation, to, profile);
        if (!curves->x_bar.empty()) add_places(view, curves->x_bar, to);
    }
    if (terms.discontinuities) add_discontinuities(view, accumulation, to, profile);
}

#define EDGEGRAD_INSTANTIATE(T)                                                                                      \
    template SampleCounts wanted_samples(const BackwardView<T>&, const Terms&);                                      \
    template SampleCounts within_budget(const BackwardInput<T>&, const GradientOptions&, SampleCounts, ThreadTeam&); \
    template void add_terms(const BackwardInput<T>&, const BackwardView<T>&, const Terms&, const Accumulation&,      \
                            GradientSink&, BackwardProfile&);
EDGEGRAD_INSTANTIATE(float)
EDGEGRAD_INSTANTIATE(double)
#undef EDGEGRAD_INSTANTIATE

}  // namespace edgegrad
