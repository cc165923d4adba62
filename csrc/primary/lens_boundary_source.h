// This file holds the curve source of the lens boundary (camera/lens_boundary.h), along which the image jumps from the
// scene to the background.
//
// It contributes ∫ Ã · [L_inside − L_background] (∂x/∂Φ · N) dθ to ∂loss/∂Φ. The normal N points outwards and is as
// long as dx/dθ. The ray of a sample is that of the lens boundary itself, the last one in view.
#pragma once

#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "boundary/accumulation.h"
#include "boundary/curve_source.h"
#include "camera/lens_boundary.h"
#include "estimator/view.h"
#include "rays/camera_rays.h"

namespace edgegrad {

struct LensBoundaryArc {
    LensBoundary::Arc arc;
    double length, measure;  // px; and px times the mean |A| near it
};

// LensBoundaryCurve divides the lens boundary into arcs of a few pixels, where the adjoint is not zero.
struct LensBoundaryCurve {
    const LensBoundary lens_boundary;
    std::vector<LensBoundaryArc> arcs;

    LensBoundaryCurve(const Camera& camera, const Importance& importance) : lens_boundary(camera) {
        constexpr int whole = 64;
        for (int i = 0; i < whole; ++i) add(importance, {2 * M_PI * i / whole, 2 * M_PI * (i + 1) / whole});
    }

   private:
    static constexpr double longest = 4;  // px

    void add(const Importance& importance, LensBoundary::Arc arc) {
        Vec2 low, high;
        if (!lens_boundary.box(arc, low, high)) return;
        const double mean = importance.mean(low, high),
                     size = length(lens_boundary.place(arc.to) - lens_boundary.place(arc.from));
        if (!(mean > 0) || !std::isfinite(size)) return;
        if (size <= longest) return arcs.push_back({arc, size, size * mean});
        const double middle = 0.5 * (arc.from + arc.to);
        add(importance, {arc.from, middle}), add(importance, {middle, arc.to});
    }
};

// LensBoundarySource answers what an accumulation asks of a curve source.
class LensBoundarySource {
   public:
    struct Sample {
        Vec2 x, normal;  // px, and N
        LensBoundary::Point point;
        double weight;  // reciprocal density of samples along the arc
        SurfacePoint inside;
    };

    explicit LensBoundarySource(const LensBoundary& lens_boundary) : lens_boundary_(lens_boundary) {}

    SampleSurfaces surfaces(const Sample& sample) const { return {{sample.inside, SurfacePoint()}}; }
    CurveJumps jumps(const Sample& sample, const double* radiance) const {
        return {sample.weight * (radiance[0] - radiance[1]), 0};
    }
    Vec2 normal(const Sample& sample) const { return sample.normal; }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const Vec2 moved = lens_boundary_.velocity(sample.point, direction.intrinsics);
        return {moved.x * sample.normal.x + moved.y * sample.normal.y, 0};
    }
    void add_motion(const Sample& sample, CurveJumps jumps, LocalGradients& grad) const {
        lens_boundary_.velocity_vjp(sample.point, jumps.first * sample.normal, grad.k);
    }
    void finish(LocalGradients&) {}

   private:
    const LensBoundary& lens_boundary_;
};
static_assert(MovingCurve<LensBoundarySource>);

// LensBoundarySamples traces samples in batches. Rays ignore no face, because nothing occludes the lens boundary.
template <class T>
class LensBoundarySamples {
   public:
    LensBoundarySamples(const BackwardView<T>& view, const LensBoundary& lens_boundary, CurveAccumulation& accumulation)
        : view_(view),
          lens_boundary_(lens_boundary),
          source_(lens_boundary),
          accumulation_(accumulation),
          rays_(view.frame) {}

    // Adds the point at the fraction s of an arc. Its x shows the inside, for accumulations that cast a ray there.
    void add(LensBoundary::Arc arc, double s, double weight) {
        const int i = rays_.count;
        const std::optional<LensBoundary::Point> point = lens_boundary_.at(arc.from + s * (arc.to - arc.from));
        if (!point || !accumulation_.wants(i, point->x)) return;
        sample_[i] = {.x = point->x - (inwards / length(point->tangent)) * lens_boundary_.outward(point->tangent),
                      .normal = (arc.to - arc.from) * lens_boundary_.outward(point->tangent),
                      .point = *point,
                      .weight = weight,
                      .inside = {}};
        // Right behind a fisheye n is about 1e-16. Embree may miss a face if a ray has so small components.
        const auto rounded = [](double x) { return std::fabs(x) < 1e-12 ? 0.0 : x; };
        rays_.n_x[i] = rounded(point->n.x), rays_.n_y[i] = rounded(point->n.y);
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish(LocalGradients& grad) {
        cast();
        source_.finish(grad);
    }

   private:
    static constexpr double inwards = 1e-6;  // px

    void cast() {
        rays_.prepare();
        view_.frame.cast(rays_);
        for (int i = 0; i < rays_.count; ++i) {
            const int32_t face = rays_.face[i];
            if (face < 0) continue;  // The background is on both sides.
            const Vec2 n = rays_.n(i);
            const FaceMap map = face_map(view_.camera, corners_of(view_, face).data());
            sample_[i].inside = {face, barycentrics_of_hit(map, n), depth_of(view_, face, n)};
            accumulation_.add(i, source_, sample_[i]);
        }
        rays_.count = 0;
    }

    const BackwardView<T>& view_;
    const LensBoundary& lens_boundary_;
    LensBoundarySource source_;
    CurveAccumulation& accumulation_;
    CameraRays rays_;
    LensBoundarySource::Sample sample_[RayBatch::size];
};

}  // namespace edgegrad
