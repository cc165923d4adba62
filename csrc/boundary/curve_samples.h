// This file traces the samples of one curve source, one ray each, and accumulates the results.
#pragma once

#include <algorithm>
#include <span>
#include <vector>

#include "boundary/accumulation.h"
#include "boundary/curve_source.h"
#include "boundary/visibility.h"

namespace edgegrad {

// CurveSamples traces samples in batches of rays. The accumulation has the functions of CurveAccumulation.
template <class Accumulation, class T, CurveSource Source>
class CurveSamples {
   public:
    CurveSamples(const BackwardView<T>& view, Source& source, Accumulation& accumulation)
        : view_(view), visibility_(view), source_(source), accumulation_(accumulation), rays_(view.frame) {}

    // Adds the point at the fraction s of the curve.
    void add(const typename Source::Curve& curve, double s, double weight) {
        const int i = rays_.count;
        const Vec2 u = source_.position(curve, s);
        const auto [x, area_scale] = distort(view_.camera, u);
        if (area_scale == 0 || !accumulation_.wants(i, x)) return;
        typename Source::Sample& sample = sample_[i];
        sample.u = u, sample.n = normalised(view_.camera, u), sample.weight = weight;
        sample.x = x, sample.area_scale = area_scale, sample.transparent.clear();
        sample.sight = sample.n;
        if (!source_.place(curve, s, sample)) return;
        rays_.n_x[i] = sample.sight.x, rays_.n_y[i] = sample.sight.y;
        ignored_[i] = sample.ignored;
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish(LocalGradients& grad) {
        cast();
        source_.finish(grad);
    }

    void cast() {
        rays_.prepare();
        view_.frame.cast(rays_, ignored_);
        for (int i = 0; i < rays_.count; ++i) {
            typename Source::Sample& sample = sample_[i];
            const int32_t hit = hiding(sample, rays_.face[i]);
            if (hit < 0 || (view_.transparent && is_seen_through(hit, sample))) accumulation_.add(i, source_, sample);
        }
        rays_.count = 0;
        source_.cast();
    }

   private:
    // Returns the face that occludes the point; −1: none. `face` is what the cast found.
    int32_t hiding(typename Source::Sample& sample, int32_t face) const {
        const int32_t hit = visibility_.exact_hit(sample, face);
        return hit < 0 || visibility_.lies_behind(hit, source_.faces_of(sample), sample) ? -1 : hit;
    }

    // Returns whether only transparent faces occlude the point: `hit` and others behind it.
    bool is_seen_through(int32_t hit, typename Source::Sample& sample) const {
        // An image composes this many transparent layers before another surface (edgegrad/points/blend.py).
        constexpr size_t most = 7;
        const auto own = sample.ignored;
        std::vector<int32_t> ignored(own.begin(), own.end());
        std::sort(ignored.begin(), ignored.end());
        while (hit >= 0 && view_.transparent[hit] && sample.transparent.size() < most) {
            sample.transparent.push_back(hit);
            ignored.insert(std::upper_bound(ignored.begin(), ignored.end(), hit), hit);
            sample.ignored = ignored;
            CameraRays ray(view_.frame);
            ray.n_x[0] = sample.sight.x, ray.n_y[0] = sample.sight.y, ray.count = 1;
            ray.prepare();
            view_.frame.cast(ray, &sample.ignored);
            hit = hiding(sample, ray.face[0]);
        }
        sample.ignored = own;
        return hit < 0;
    }

    const BackwardView<T>& view_;
    const Visibility<T> visibility_;
    Source& source_;
    Accumulation& accumulation_;

    CameraRays rays_;
    typename Source::Sample sample_[RayBatch::size];
    std::span<const int32_t> ignored_[RayBatch::size];
};

}  // namespace edgegrad
