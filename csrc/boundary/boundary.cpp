// The estimator of the boundary term: samples over all curves, one ray each.

#include "boundary/boundary.h"

#include <algorithm>
#include <span>
#include <vector>

#include "boundary/crease_control.h"
#include "boundary/crossings.h"
#include "boundary/curve_measure.h"
#include "boundary/edge_source.h"
#include "core/channels.h"
#include "core/sampler.h"
#include "core/systematic.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

// Samples of one source, in batches of rays.
template <int N, class T, CurveSource Source>
class CurveSamples {
   public:
    CurveSamples(const BackwardView<T>& view, Source& source, ChunkGrad& grad)
        : view_(view),
          visibility_(view),
          source_(source),
          grad_(grad),
          C_(N ? N : view.scene.channels),
          rays_(view.frame),
          adjoint_(RayBatch::size * C_),
          radiance_(C_) {}

    // The point at the fraction s of the curve.
    void add(const typename Source::Curve& curve, double s, double weight) {
        const int i = rays_.count;
        const Vec2 x = source_.position(curve, s);
        if (!view_.adjoint.template at<N>(x, adjoint_.data() + i * C_)) return;
        typename Source::Sample& sample = sample_[i];
        sample.x = x, sample.n = normalised(view_.camera, x), sample.weight = weight;
        if (!source_.place(curve, s, sample)) return;
        rays_.n_x[i] = sample.n.x, rays_.n_y[i] = sample.n.y;
        ignored_[i] = sample.ignored;
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish() {
        cast();
        source_.finish(grad_);
    }

   private:
    void cast() {
        rays_.prepare();
        view_.geometry.caster().cast(rays_, ignored_);
        for (int i = 0; i < rays_.count; ++i) {
            typename Source::Sample& sample = sample_[i];
            const int32_t hit = visibility_.beyond_float(sample, rays_.face[i]);
            if (hit >= 0 && !visibility_.lies_behind(hit, source_.faces_of(sample), sample)) continue;
            const SampleSurfaces surfaces = source_.surfaces(sample);
            double radiance[SampleSurfaces::most];
            for (int k = 0; k < surfaces.count; ++k)
                radiance[k] = adjoint_radiance(sample.x, surfaces.at[k], adjoint_.data() + i * C_);
            source_.add_motion(sample, radiance, grad_);
        }
        rays_.count = 0;
        source_.cast();
    }

    // Ã · L of a point of a face, or of the background.
    double adjoint_radiance(Vec2 x, const SurfacePoint& p, const double* adjoint) {
        if (p.face < 0) return view_.adjoint.template times_background<N>(x);
        shade<N>(view_.scene, p.face, p.b, radiance_.data());
        double sum = 0;
        for (int c = 0; c < C_; ++c) sum += adjoint[c] * radiance_[c];
        return sum;
    }

    const BackwardView<T>& view_;
    const Visibility<T> visibility_;
    Source& source_;
    ChunkGrad& grad_;
    const int C_;

    RayBatch rays_;
    typename Source::Sample sample_[RayBatch::size];
    std::span<const int32_t> ignored_[RayBatch::size];
    std::vector<double> adjoint_, radiance_;
};

}  // namespace

template <int N, class T>
void add_boundary(const BackwardView<T>& view, Curves<T>& curves, int64_t n, Destination& to,
                  BackwardProfile& profile) {
    profile.edge_samples = n;
    if (n == 0 || view.options.dry) return;
    Stopwatch watch;
    const CurveFinder<T>& finder = curves.finder;
    Systematic systematic(curves.measure, view.team);
    if (!(systematic.total() > 0)) return;
    systematic.draw(n, to_unit(hash(view.options.seed, 3, gradient_stream)));
    const CoincidentCurves coincident(std::move(curves.segments), systematic, view.team);
    profile.curves += watch.lap();
    if (!curves.x_bar.empty()) to.x = curves.x_bar.data();
    view.scatter.add(n, to, profile.edge, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        EdgeSource<T> edges(view, finder, coincident);
        CurveSamples<N, T, EdgeSource<T>> samples(view, edges, grad);
        CreaseControl<N, T> control(view);
        Curve curve;
        bool controlled = false;
        int64_t k = systematic.primitive(systematic.position(first));
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            k = systematic.primitive(position, k);
            if (const MeasuredCurve& measured = curves.curve[k]; curve.edge != measured.edge) {
                if (controlled) control.flush(grad.x);
                finder.find(measured.edge, curve);
                controlled = measured.controlled && control.set(curve);
            }
            const double weight = systematic.weight(k);
            const double end = curve.is_crease() ? std::min(Crossings::float_reach / curve.length, 0.1) : 0;
            const double s = std::clamp((position - systematic.begin_of(k)) / systematic.measure_of(k), end, 1 - end);
            if (controlled) control.subtract(s, weight);
            samples.add(curve, s, weight);
        }
        if (controlled) control.flush(grad.x);
        samples.finish();
    });
    to.x = nullptr;
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template void add_boundary<N, float>(const BackwardView<float>&, Curves<float>&, int64_t, Destination&, BackwardProfile&); \
    template void add_boundary<N, double>(const BackwardView<double>&, Curves<double>&, int64_t, Destination&, BackwardProfile&);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
