// This file estimates the boundary term from samples over all curves, with one ray each.

#include "primary/primary_curves.h"

#include <algorithm>
#include <memory>
#include <vector>

#include "boundary/accumulation.h"
#include "boundary/curve_samples.h"
#include "core/ordered_draws.h"
#include "core/sampler.h"
#include "core/systematic.h"
#include "primary/crease_control.h"
#include "primary/curve_measure.h"
#include "primary/edge_source.h"
#include "primary/intersection_source.h"
#include "primary/lens_boundary_source.h"
#include "primary/silhouette_grid.h"

namespace edgegrad {

namespace {

// VisibilityQuery only tells whether a sample is visible.
class VisibilityQuery final : public CurveAccumulation {
   public:
    bool visible = false;

    bool wants(int, Vec2) override { return true; }

   private:
    void accumulate(int, MovingSample&) override { visible = true; }
};

// Edges, intersections and the lens boundary are numbered as primitives in this order.
enum CurveKind { on_edges, on_intersections, on_lens_boundary };

template <class T>
OrderedDraws ordered(const BackwardView<T>& view, const Curves<T>& curves, const Systematic& systematic, int64_t n) {
    const int64_t edges = curves.curve.size(), lines = edges + int64_t(curves.intersection.size());
    const auto cell = [&](int64_t k) -> uint16_t {
        if (k >= lines) return 0;
        if (k >= edges) {
            const Intersection& i = curves.lines(view.geometry)[curves.intersection[k - edges].index];
            return cell_of(view, view.scene.faces[3 * int64_t(i.face[0])]);
        }
        const HalfEdge& h = view.geometry.topology().half_edges(curves.curve[k].edge)[0];
        return cell_of(view, vertex(view.scene, h, h.first()));
    };
    return {systematic, n, {edges, lines, lines + curves.arcs()}, cell, view.team};
}

// SampleRange is a range of the samples.
struct SampleRange {
    const OrderedDraws& draws;
    int64_t first, last;

    // Calls body(k, s, weight) for each sample, on the curve k at its fraction s.
    template <class Body>
    void each(Body body) const {
        const Systematic& systematic = draws.systematic();
        draws.each(first, last, [&](int64_t k, int64_t i) {
            body(k, (systematic.position(i) - systematic.begin_of(k)) / systematic.measure_of(k), systematic.weight(k));
        });
    }
};

// Keeps samples off the ends of a crease, so far that rounding of a silhouette there does not matter.
double kept_off_ends(const Curve& curve, double s) {
    const double end = curve.is_crease() ? std::min(float_reach / curve.length, 0.1) : 0;
    return std::clamp(s, end, 1 - end);
}

// Finds the curve, unless it is the current one. Returns false if it has no extent.
template <class T>
bool find(const Curves<T>& curves, const MeasuredCurve& measured, Curve& curve) {
    if (curve.edge == measured.edge || curves.finder.find(measured.edge, curve)) return true;
    curve.edge = -1;
    return false;
}

// Returns whether any sample of a crease between hidden faces is visible after all. No silhouette passes before these
// faces. Other curves on a crease (coincident_segments.h) therefore cannot affect whether something hides it.
template <class T>
bool any_visible(const BackwardView<T>& view, const Curves<T>& curves, const OrderedDraws& draws) {
    if (!curves.any_hidden) return false;
    const int64_t n = draws.end_of_kind(on_edges);
    const CoincidentCurves alone({}, draws.systematic(), view.team);
    std::vector<uint8_t> found((n + scatter_chunk - 1) / scatter_chunk, 0);
    view.team.parallel_for(int64_t(found.size()), [&](int64_t chunk) {
        VisibilityQuery query;
        CurveAccumulation& accumulation = query;
        EdgeSource<T> source(view, curves.finder, alone);
        CurveSamples samples(view, source, accumulation);
        Curve curve;
        const SampleRange drawn{draws, chunk * scatter_chunk, std::min(n, (chunk + 1) * scatter_chunk)};
        drawn.each([&](int64_t k, double s, double weight) {
            if (!curves.curve[k].hidden) return;
            if (!find(curves, curves.curve[k], curve)) return;
            samples.add(curve, kept_off_ends(curve, s), weight);
        });
        samples.cast();
        found[chunk] = query.visible;
    });
    return std::find(found.begin(), found.end(), 1) != found.end();
}

template <class T>
void add_edges(const BackwardView<T>& view, const Curves<T>& curves, const CoincidentCurves& coincident, bool hidden,
               const SampleRange& drawn, CurveAccumulation& accumulation, LocalGradients& grad) {
    EdgeSource<T> source(view, curves.finder, coincident);
    CurveSamples samples(view, source, accumulation);
    const std::unique_ptr<CreaseControl> control = make_crease_control(view);
    Curve curve;
    bool controlled = false;
    drawn.each([&](int64_t k, double s, double weight) {
        const MeasuredCurve& measured = curves.curve[k];
        if (measured.hidden && !hidden) return;
        if (curve.edge != measured.edge) {
            if (controlled) control->flush(grad.x);
            controlled = false;
            if (!find(curves, measured, curve)) return;
            controlled = measured.controlled && control->set(curve);
        }
        s = kept_off_ends(curve, s);
        if (controlled) control->subtract(s, weight);
        samples.add(curve, s, weight);
    });
    if (controlled) control->flush(grad.x);
    samples.finish(grad);
}

template <class T>
void add_intersections(const BackwardView<T>& view, const Curves<T>& curves, const SampleRange& drawn,
                       CurveAccumulation& accumulation, LocalGradients& grad) {
    const Array<Intersection>& all = curves.lines(view.geometry);
    IntersectionSource<T> source(view);
    CurveSamples samples(view, source, accumulation);
    IntersectionCurve curve;
    drawn.each([&](int64_t k, double s, double weight) {
        const Intersection& i = all[curves.intersection[k - int64_t(curves.curve.size())].index];
        if (curve.faces != &i) find_intersection(view, curves.finder.facing(), i, curve);
        samples.add(curve, std::clamp(s, 0.0, 1.0), weight);
    });
    samples.finish(grad);
}

template <class T>
void add_lens_boundary(const BackwardView<T>& view, const Curves<T>& curves, const SampleRange& drawn,
                       CurveAccumulation& accumulation, LocalGradients& grad) {
    LensBoundarySamples samples(view, curves.lens_boundary_curve->lens_boundary, accumulation);
    const auto before = int64_t(curves.curve.size() + curves.intersection.size());
    drawn.each([&](int64_t k, double s, double weight) {
        samples.add(curves.lens_boundary_curve->arcs[k - before].arc, std::clamp(s, 0.0, 1.0), weight);
    });
    samples.finish(grad);
}

}  // namespace

template <class T>
void add_boundary(const BackwardView<T>& view, Curves<T>& curves, int64_t n, const Accumulation& accumulation,
                  GradientSink& to, BackwardProfile& profile) {
    profile.edge_samples = n;
    if (n == 0 || view.options.dry) return;
    Stopwatch watch;
    Systematic systematic(curves.measure, view.team);
    if (!(systematic.total() > 0)) return;
    systematic.draw(n, to_unit(seed_of(view.options.seed, Stream::primary_curves)));
    const OrderedDraws draws = ordered(view, curves, systematic, n);
    const bool hidden = any_visible(view, curves, draws);  // whether creases between hidden faces count after all
    curves.add_segments(view, systematic, hidden);
    const CoincidentCurves coincident(std::move(curves.segments), systematic, view.team);
    profile.curves += watch.lap();
    if (!curves.x_bar.empty()) to.x = curves.x_bar.data();
    view.scatter.add(n, to, profile.edge, [&](int64_t first, int64_t last, LocalGradients& grad) {
        const std::unique_ptr<CurveAccumulation> to_chunk = accumulate_curves(view, accumulation, grad);
        const auto part = [&](CurveKind kind) {
            const int64_t begin = kind ? draws.end_of_kind(kind - 1) : 0;
            return SampleRange{draws, std::max(first, begin), std::min(last, draws.end_of_kind(kind))};
        };
        if (const SampleRange d = part(on_edges); d.first < d.last)
            add_edges(view, curves, coincident, hidden, d, *to_chunk, grad);
        if (const SampleRange d = part(on_intersections); d.first < d.last)
            add_intersections(view, curves, d, *to_chunk, grad);
        if (const SampleRange d = part(on_lens_boundary); d.first < d.last)
            add_lens_boundary(view, curves, d, *to_chunk, grad);
    });
    to.x = nullptr;
}

template void add_boundary(const BackwardView<float>&, Curves<float>&, int64_t, const Accumulation&, GradientSink&,
                           BackwardProfile&);
template void add_boundary(const BackwardView<double>&, Curves<double>&, int64_t, const Accumulation&, GradientSink&,
                           BackwardProfile&);

}  // namespace edgegrad
