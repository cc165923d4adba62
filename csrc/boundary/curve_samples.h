// Samples of one source of curves: one ray each, and what is found contracted.
#pragma once

#include <span>

#include "boundary/contractions.h"
#include "boundary/curve_source.h"
#include "boundary/visibility.h"

namespace edgegrad {

// Samples of one source, in batches of rays. The contraction is a CurveContraction, or offers the same.
template <class Contraction, class T, CurveSource Source>
class CurveSamples {
   public:
    CurveSamples(const BackwardView<T>& view, Source& source, Contraction& contraction)
        : view_(view), visibility_(view), source_(source), contraction_(contraction), rays_(view.frame) {}

    // The point at the fraction s of the curve.
    void add(const typename Source::Curve& curve, double s, double weight) {
        const int i = rays_.count;
        const Vec2 u = source_.position(curve, s);
        const auto [x, area_scale] = bend(view_.camera, u);
        if (area_scale == 0 || !contraction_.wants(i, x)) return;
        typename Source::Sample& sample = sample_[i];
        sample.u = u, sample.n = normalised(view_.camera, u), sample.weight = weight;
        sample.x = x, sample.area_scale = area_scale;
        if (!source_.place(curve, s, sample)) return;
        rays_.n_x[i] = sample.n.x, rays_.n_y[i] = sample.n.y;
        ignored_[i] = sample.ignored;
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish(ChunkGrad& grad) {
        cast();
        source_.finish(grad);
    }

    void cast() {
        rays_.prepare();
        view_.frame.cast(rays_, ignored_);
        for (int i = 0; i < rays_.count; ++i) {
            typename Source::Sample& sample = sample_[i];
            const int32_t hit = visibility_.beyond_float(sample, rays_.face[i]);
            if (hit >= 0 && !visibility_.lies_behind(hit, source_.faces_of(sample), sample)) continue;
            contraction_.add(i, source_, sample);
        }
        rays_.count = 0;
        source_.cast();
    }

   private:
    const BackwardView<T>& view_;
    const Visibility<T> visibility_;
    Source& source_;
    Contraction& contraction_;

    CameraRays rays_;
    typename Source::Sample sample_[RayBatch::size];
    std::span<const int32_t> ignored_[RayBatch::size];
};

}  // namespace edgegrad
