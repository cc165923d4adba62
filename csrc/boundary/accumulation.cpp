#include "boundary/accumulation.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/channels.h"
#include "film/film.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

// AdjointRadiance evaluates Ã · L in place of the radiance: one number per surface.
template <int N, class T>
class AdjointRadiance {
   public:
    explicit AdjointRadiance(const BackwardView<T>& view)
        : view_(view), C_(channels_of<N>(view.scene)), adjoint_(RayBatch::size * C_), radiance_(C_) {}

    bool wants(int i, Vec2 x) { return view_.adjoint.template at<N>(x, adjoint_.data() + i * C_); }

    double of(int i, Vec2 x, const SurfacePoint& p) {
        if (p.face < 0) return view_.adjoint.template times_background<N>(x);
        shade<N>(view_.scene, p.face, p.b, radiance_.data());
        const double* adjoint = adjoint_.data() + i * C_;
        double sum = 0;
        for (int c = 0; c < C_; ++c) sum += adjoint[c] * radiance_[c];
        return sum;
    }

    // Returns the jumps of the loss at a sample.
    CurveJumps jumps(int i, MovingSample& sample) {
        const SampleSurfaces surfaces = sample.surfaces();
        const Vec2 x = sample.x();
        double radiance[SampleSurfaces::most];
        for (int k = 0; k < surfaces.count; ++k) radiance[k] = of(i, x, surfaces.at[k]);
        return sample.jumps(radiance);
    }

   private:
    const BackwardView<T>& view_;
    const int C_;
    std::vector<double> adjoint_, radiance_;
};

template <int N, class T>
class ReverseBoundary final : public CurveAccumulation {
   public:
    ReverseBoundary(const BackwardView<T>& view, LocalGradients& grad) : radiance_(view), grad_(grad) {}

    bool wants(int i, Vec2 x) override { return radiance_.wants(i, x); }

   private:
    void accumulate(int i, MovingSample& sample) override { sample.add_motion(radiance_.jumps(i, sample), grad_); }

    AdjointRadiance<N, T> radiance_;
    LocalGradients& grad_;
};

template <class T>
class ForwardBoundary final : public CurveAccumulation {
   public:
    ForwardBoundary(const BackwardView<T>& view, Directions directions, LocalGradients& grad)
        : view_(view),
          directions_(directions),
          C_(view.scene.channels),
          pixels_(view.image.filter, view.camera.width, view.camera.height),
          grad_(grad),
          radiance_(SampleSurfaces::most * C_),
          values_(directions.size() * C_) {}

    bool wants(int, Vec2) override { return true; }

   private:
    void accumulate(int, MovingSample& sample) override {
        const SampleSurfaces surfaces = sample.surfaces();
        for (int k = 0; k < surfaces.count; ++k)
            if (const SurfacePoint& p = surfaces.at[k]; p.face >= 0)
                shade<0>(view_.scene, p.face, p.b, radiance_.data() + k * C_);
        velocity_.resize(directions_.size());
        for (size_t d = 0; d < directions_.size(); ++d) velocity_[d] = sample.velocities(directions_[d]);
        pixels_.around(sample.x(), [&](int64_t pixel, double weight) {
            // Each pixel has its own background.
            const T* background = view_.scene.background_at(pixel);
            for (int c = 0; c < C_; ++c) {
                double radiance[SampleSurfaces::most];
                for (int k = 0; k < surfaces.count; ++k)
                    radiance[k] = surfaces.at[k].face >= 0 ? radiance_[k * C_ + c] : double(background[c]);
                const CurveJumps jumps = sample.jumps(radiance);
                for (size_t d = 0; d < directions_.size(); ++d)
                    values_[d * C_ + c] =
                        weight * (jumps.first * velocity_[d].first + jumps.second * velocity_[d].second);
            }
            grad_.pixels.add(pixel, values_.data());
        });
    }

    const BackwardView<T>& view_;
    const Directions directions_;
    const int C_;
    const FilteredPixels pixels_;
    LocalGradients& grad_;
    std::vector<double> radiance_;  // (3, C), one row per surface
    std::vector<CurveJumps> velocity_;
    std::vector<double> values_;  // (D, C)
};

template <class T>
class ScreenBoundary final : public CurveAccumulation {
   public:
    ScreenBoundary(const BackwardView<T>& view, LocalGradients& grad) : view_(view), radiance_(view), grad_(grad) {}

    bool wants(int i, Vec2 x) override { return radiance_.wants(i, x); }

   private:
    void accumulate(int i, MovingSample& sample) override {
        const CurveJumps jumps = radiance_.jumps(i, sample);
        const Vec2 moved = (jumps.first + jumps.second) * sample.normal();
        grad_.pixels.template add<2>(view_.pixel(sample.x()), &moved.x);
    }

    const BackwardView<T>& view_;
    AdjointRadiance<0, T> radiance_;
    LocalGradients& grad_;
};

template <class T>
class BoundaryRecorder final : public CurveAccumulation {
   public:
    BoundaryRecorder(const BackwardView<T>& view, const Record& kept, CurveRecords& records)
        : view_(view), kept_(kept), camera_(view.camera), records_(records) {
        form_.q.prepare(3, 1), form_.uvs.prepare(2, 1), form_.alphas.prepare(1, 1);
        records_.reserve(scatter_chunk);
    }

    bool wants(int, Vec2) override { return true; }

   private:
    static_assert(CurveRecords::surfaces == SampleSurfaces::most);

    void accumulate(int, MovingSample& sample) override {
        const SampleSurfaces surfaces = sample.surfaces();
        double first[CurveRecords::surfaces] = {}, second[CurveRecords::surfaces] = {};
        for (int k = 0; k < surfaces.count; ++k) {
            double radiance[SampleSurfaces::most] = {};
            radiance[k] = 1;
            const CurveJumps jumps = sample.jumps(radiance);
            first[k] = jumps.first, second[k] = jumps.second;
        }
        add(sample, surfaces, {1, 0}, first), add(sample, surfaces, {0, 1}, second);
    }

    // Appends one of the two curves. Its velocity is the map of which add_motion() is the adjoint.
    void add(MovingSample& sample, const SampleSurfaces& surfaces, CurveJumps curve, const double* factor) {
        if (std::all_of(factor, factor + CurveRecords::surfaces, [](double f) { return f == 0; })) return;
        form_.q.clear(), form_.uvs.clear(), form_.alphas.clear();
        form_.k = {}, form_.light = {};
        sample.add_motion(curve, form_);
        sample.finish(form_);
        const int64_t sample_index = records_.size();
        append(records_.x, {sample.x().x, sample.x().y});
        const CurveSample* sides = sample.on_surfaces();
        const Vec2 normal = sides ? in_undistorted_image(sample.normal(), sides->n) : Vec2();
        for (int k = 0; k < CurveRecords::surfaces; ++k) {
            const SurfacePoint p = k < surfaces.count ? surfaces.at[k] : SurfacePoint();
            records_.face.push_back(k < surfaces.count ? int32_t(p.face) : -2);
            Barycentrics b = p.b;
            if (sides && factor[k] != 0 && p.face >= 0) b = aside(p, *sides, normal, factor[k] > 0 ? -1 : 1);
            append(records_.b, {b.u, b.v});
            records_.factor.push_back(factor[k]);
        }
        if (kept_.intrinsics) append_intrinsics(records_.by_k, camera_, form_.k);
        form_.q.each([&](int64_t vertex, const double* by_q) {
            if (by_q[0] == 0 && by_q[1] == 0 && by_q[2] == 0) return;
            records_.row_of.push_back(sample_index);
            records_.vertex.push_back(int32_t(vertex));
            // by_q is rotated from the frame of the sub-camera to that of the camera.
            const Vec3 q = transposed_times(camera_.rotation, {by_q[0], by_q[1], by_q[2]});
            append(records_.by_q, {q.x, q.y, q.z});
        });
        form_.uvs.each([&](int64_t row, const double* by_uv) {
            records_.uv_row_of.push_back(sample_index), records_.uv.push_back(int32_t(row));
            append(records_.by_uv, {by_uv[0], by_uv[1]});
        });
        form_.alphas.each([&](int64_t texel, const double* by_alpha) {
            records_.alpha_row_of.push_back(sample_index), records_.alpha.push_back(texel);
            records_.by_alpha.push_back(*by_alpha);
        });
        if (sides)
            for (const int32_t face : sides->transparent) {
                const Barycentrics b = barycentrics_of_hit(face_map(camera_, corners_of(view_, face).data()), sides->n);
                records_.transparent_row_of.push_back(sample_index), records_.transparent.push_back(face);
                append(records_.transparent_b, {b.u, b.v});
            }
        if (const LightMotion& light = form_.light; light.part >= 0) {
            records_.light.push_back(light.part), append(records_.light_uv, {light.uv.x, light.uv.y});
            const Vec3 place = transposed_times(camera_.rotation, light.by_place);
            append(records_.by_light, {place.x, place.y, place.z});
        }
    }

    // Returns (∂x/∂u)ᵀ x̄.
    Vec2 in_undistorted_image(Vec2 x_bar, Vec2 n) const {
        const auto along = [&](Vec2 u) {
            const Vec2 x = distort_jvp(camera_, n, u);
            return x.x * x_bar.x + x.y * x_bar.y;
        };
        return {along({1, 0}), along({0, 1})};
    }

    // Returns a point of a surface moved slightly off the curve, to its visible side. Only there is it known what lies
    // between the point and a light at a contact curve, and which side of a discontinuity applies.
    Barycentrics aside(const SurfacePoint& p, const CurveSample& sample, Vec2 normal, double side) const {
        constexpr double most = 1e-2;  // maximum motion in barycentrics
        const double size = length(normal);
        if (!(size > 0 && std::isfinite(size))) return p.b;
        const auto corner = corners_of(view_, p.face);
        Barycentrics b;
        if (!barycentrics(face_map(camera_, corner.data()),
                          normalised(camera_, sample.u + (side * view_.curve_offset / size) * normal), b))
            return p.b;
        const double u = b.u - p.b.u, v = b.v - p.b.v, moved = std::max(std::fabs(u), std::fabs(v));
        const double part = moved > most ? most / moved : 1;
        return inside({p.b.u + part * u, p.b.v + part * v});
    }

    const BackwardView<T>& view_;
    const Record kept_;
    const Camera& camera_;
    CurveRecords& records_;
    LocalGradients form_;
};

}  // namespace

template <class T>
std::unique_ptr<CurveAccumulation> accumulate_curves(const BackwardView<T>& view, const Accumulation& accumulation,
                                                     LocalGradients& grad) {
    using Made = std::unique_ptr<CurveAccumulation>;
    if (std::holds_alternative<Reverse>(accumulation))
        return dispatch_channels(view.scene.channels, view.scene.channels > view.scene.radiance,
                                 [&]<int N>() -> Made { return std::make_unique<ReverseBoundary<N, T>>(view, grad); });
    if (const Forward* c = std::get_if<Forward>(&accumulation))
        return std::make_unique<ForwardBoundary<T>>(view, c->directions, grad);
    if (const Record* c = std::get_if<Record>(&accumulation))
        return std::make_unique<BoundaryRecorder<T>>(view, *c, grad.records.curves);
    return std::make_unique<ScreenBoundary<T>>(view, grad);
}

template std::unique_ptr<CurveAccumulation> accumulate_curves(const BackwardView<float>&, const Accumulation&,
                                                              LocalGradients&);
template std::unique_ptr<CurveAccumulation> accumulate_curves(const BackwardView<double>&, const Accumulation&,
                                                              LocalGradients&);

}  // namespace edgegrad
