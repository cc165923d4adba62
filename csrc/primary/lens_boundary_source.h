// The rim of what a lens shows (camera/lens_boundary.h), along which the image jumps from the scene to the background.
//
// Its share of ∂loss/∂Φ is ∫ Ã · [L_inside − L_background] (∂x/∂Φ · N) dθ, with N the normal that points outwards, as
// long as dx/dθ. The ray of a sample is that of the rim itself, the last that is seen.
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

struct RimArc {
    Rim::Arc arc;
    double length, measure;  // px; and with the mean |Ã| near it
};

// The rim in arcs of a few pixels: those where the loss looks.
struct RimCurve {
    const Rim rim;
    std::vector<RimArc> arcs;

    RimCurve(const Camera& camera, const Importance& importance) : rim(camera) {
        constexpr int whole = 64;
        for (int i = 0; i < whole; ++i) add(importance, {2 * M_PI * i / whole, 2 * M_PI * (i + 1) / whole});
    }

   private:
    static constexpr double longest = 4;  // px

    void add(const Importance& importance, Rim::Arc arc) {
        Vec2 low, high;
        if (!rim.box(arc, low, high)) return;
        const double mean = importance.mean(low, high), size = length(rim.place(arc.to) - rim.place(arc.from));
        if (!(mean > 0) || !std::isfinite(size)) return;
        if (size <= longest) return arcs.push_back({arc, size, size * mean});
        const double middle = 0.5 * (arc.from + arc.to);
        add(importance, {arc.from, middle}), add(importance, {middle, arc.to});
    }
};

// What a contraction asks of it.
class RimSource {
   public:
    struct Sample {
        Vec2 x, normal;  // px, and N
        Rim::Point point;
        double weight;  // inverse of the density of samples along the arc
        SurfacePoint inside;
    };

    explicit RimSource(const Rim& rim) : rim_(rim) {}

    SampleSurfaces surfaces(const Sample& sample) const { return {{sample.inside, SurfacePoint()}}; }
    CurveJumps jumps(const Sample& sample, const double* radiance) const {
        return {sample.weight * (radiance[0] - radiance[1]), 0};
    }
    Vec2 normal(const Sample& sample) const { return sample.normal; }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const Vec2 moved = rim_.velocity(sample.point, direction.intrinsics);
        return {moved.x * sample.normal.x + moved.y * sample.normal.y, 0};
    }
    void add_motion(const Sample& sample, CurveJumps jumps, ChunkGrad& grad) const {
        rim_.velocity_vjp(sample.point, jumps.first * sample.normal, grad.k);
    }
    void finish(ChunkGrad&) {}

   private:
    const Rim& rim_;
};
static_assert(MovingCurve<RimSource>);

// Samples in batches of rays, of which none ignores a face: nothing hides a point of the rim.
template <class T>
class RimSamples {
   public:
    RimSamples(const BackwardView<T>& view, const Rim& rim, CurveContraction& contraction)
        : view_(view), rim_(rim), source_(rim), contraction_(contraction), rays_(view.frame) {}

    // The point at the fraction s of an arc; its x is a place that shows the inside, for who asks there for a ray.
    void add(Rim::Arc arc, double s, double weight) {
        const int i = rays_.count;
        const std::optional<Rim::Point> point = rim_.at(arc.from + s * (arc.to - arc.from));
        if (!point || !contraction_.wants(i, point->x)) return;
        sample_[i] = {.x = point->x - (inwards / length(point->tangent)) * rim_.outward(point->tangent),
                      .normal = (arc.to - arc.from) * rim_.outward(point->tangent),
                      .point = *point,
                      .weight = weight,
                      .inside = {}};
        // Right behind a fisheye n is some 1e-16, and Embree may miss what a ray with so small components should meet.
        const auto rounded = [](double x) { return std::fabs(x) < 1e-12 ? 0.0 : x; };
        rays_.n_x[i] = rounded(point->n.x), rays_.n_y[i] = rounded(point->n.y);
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish(ChunkGrad& grad) {
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
            if (face < 0) continue;  // the background on both sides
            const Vec2 n = rays_.n(i);
            const FaceMap map = face_map(view_.camera, corners_of(view_, face).data());
            sample_[i].inside = {face, barycentrics_of_hit(map, n), depth_of(view_, face, n)};
            contraction_.add(i, source_, sample_[i]);
        }
        rays_.count = 0;
    }

    const BackwardView<T>& view_;
    const Rim& rim_;
    RimSource source_;
    CurveContraction& contraction_;
    CameraRays rays_;
    RimSource::Sample sample_[RayBatch::size];
};

}  // namespace edgegrad
