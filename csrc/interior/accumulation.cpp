#include "interior/accumulation.h"

#include <algorithm>
#include <vector>

#include "accumulate/tangent.h"
#include "core/channels.h"
#include "interior/face_grad.h"

namespace edgegrad {

namespace {

template <int N, class T>
class ReverseInterior final : public SurfaceAccumulation {
   public:
    ReverseInterior(const BackwardView<T>& view, bool geometry, const GradientSink& to, LocalGradients& grad)
        : view_(view),
          C_(channels_of<N>(view.scene)),
          run_(view, geometry, to, grad),
          weighted_(RayBatch::size * C_),
          in_pixel_(C_) {}

    bool wants(int i, const SurfaceSample& s) override {
        double* weighted = weighted_.data() + i * C_;
        if (!view_.adjoint.template at<N>(s.x, weighted) && !s.controlled) return false;
        for (int c = 0; c < C_; ++c) weighted[c] *= s.weight;
        return true;
    }

    void add(int i, const SurfaceSample& s, Vec2 n, bool visible) override {
        if (!visible && !s.controlled) return;
        if (run_.face() != s.face) run_.flush(), run_.start(s.face, s.controlled);
        if (visible) run_.add(n, weighted_.data() + i * C_);
        if (s.controlled) run_.control().subtract(s.lambda, s.share);
    }

    bool begin_pixel(int64_t pixel, double weight) override {
        const T* A = view_.adjoint.of(pixel);
        for (int c = 0; c < C_; ++c) in_pixel_[c] = weight * double(A[c]);
        return std::any_of(A, A + C_, [](T a) { return a != 0; });
    }

    // Faces alternate in a pixel and recur in the next one, so some runs stay open.
    void add_in_pixel(int32_t face, Vec2 n, Vec2) override {
        if (open_.empty()) open_ = std::vector<FaceGrad<N, T>>(32, run_);
        FaceGrad<N, T>& run = open_[unsigned(face) % open_.size()];
        if (run.face() != face) run.flush(), run.start(face);
        run.add(n, in_pixel_.data());
    }

    void finish() override {
        run_.flush();
        for (FaceGrad<N, T>& run : open_) run.flush();
    }

   private:
    const BackwardView<T>& view_;
    const int C_;
    FaceGrad<N, T> run_;
    std::vector<FaceGrad<N, T>> open_;
    std::vector<double> weighted_, in_pixel_;
};

template <class T>
class ForwardInterior final : public SurfaceAccumulation {
   public:
    ForwardInterior(const BackwardView<T>& view, Directions directions, LocalGradients& grad)
        : view_(view),
          directions_(directions),
          C_(view.scene.channels),
          splat_(FilteredPixels(view.image.filter, view.camera.width, view.camera.height), grad.pixels,
                 int(directions.size()) * C_),
          values_(directions.size() * C_) {}

    bool wants(int, const SurfaceSample&) override { return true; }

    void add(int, const SurfaceSample& s, Vec2 n, bool visible) override {
        if (!visible || !differentiate(s.face, n)) return;
        for (double& value : values_) value *= s.weight;
        splat_.add(s.x, values_);
    }

    bool begin_pixel(int64_t pixel, double weight) override {
        pixel_ = pixel, weight_ = weight;
        return true;
    }
    void add_in_pixel(int32_t face, Vec2 n, Vec2) override {
        if (differentiate(face, n)) splat_.add(pixel_, weight_, values_);
    }

    void finish() override {}

   private:
    // Writes the derivatives of the radiance at n.
    bool differentiate(int32_t face, Vec2 n) {
        const int32_t* v = view_.scene.faces + 3 * int64_t(face);
        const auto corner = corners_of(view_, face);
        const FaceMap map = face_map(view_.camera, corner.data());
        Barycentrics b;
        if (!barycentrics(map, n, b)) return false;
        for (size_t d = 0; d < directions_.size(); ++d) {
            const Direction& direction = directions_[d];
            Barycentrics b_dot;
            if (direction.moves()) {
                const Vec3 corner_dot[3] = {direction.q[v[0]], direction.q[v[1]], direction.q[v[2]]};
                b_dot = barycentrics_jvp(map, n, b, face_map_jvp(view_.camera, corner.data(), corner_dot),
                                         normalised_jvp(view_.camera, n, direction.intrinsics));
            }
            shade_jvp(view_.scene, face, b, b_dot, direction.tangents, values_.data() + d * C_);
        }
        return true;
    }

    const BackwardView<T>& view_;
    const Directions directions_;
    const int C_;
    Splat splat_;
    std::vector<double> values_;  // (D, C)
    int64_t pixel_ = 0;
    double weight_ = 1;
};

// ScreenInterior adds −Ã · ∂L/∂x: the change of the loss as what is seen at x moves in the image.
template <class T>
class ScreenInterior final : public SurfaceAccumulation {
   public:
    ScreenInterior(const BackwardView<T>& view, LocalGradients& grad)
        : view_(view), grad_(grad), adjoint_(RayBatch::size * view.scene.channels), in_pixel_(view.scene.channels) {}

    bool wants(int i, const SurfaceSample& s) override {
        double* adjoint = adjoint_.data() + i * in_pixel_.size();
        if (!view_.adjoint.template at<0>(s.x, adjoint)) return false;
        for (size_t c = 0; c < in_pixel_.size(); ++c) adjoint[c] *= s.weight;
        return true;
    }
    void add(int i, const SurfaceSample& s, Vec2 n, bool visible) override {
        if (visible) add(view_.pixel(s.x), s.face, n, adjoint_.data() + i * in_pixel_.size());
    }

    bool begin_pixel(int64_t pixel, double weight) override {
        const T* A = view_.adjoint.of(pixel);
        pixel_ = pixel;
        for (size_t c = 0; c < in_pixel_.size(); ++c) in_pixel_[c] = weight * double(A[c]);
        return std::any_of(in_pixel_.begin(), in_pixel_.end(), [](double a) { return a != 0; });
    }
    void add_in_pixel(int32_t face, Vec2 n, Vec2) override { add(pixel_, face, n, in_pixel_.data()); }

    void finish() override {}

   private:
    void add(int64_t pixel, int32_t face, Vec2 n, const double* radiance_bar) {
        const auto corner = corners_of(view_, face);
        const FaceMap map = face_map(view_.camera, corner.data());
        Barycentrics b;
        if (!barycentrics(map, n, b)) return;
        corners_.reset(view_.scene, face);
        const Barycentrics b_bar = shade_vjp<0>(view_.scene, face, b, radiance_bar, false, corners_, grad_);
        FaceMap map_bar;
        Vec2 n_bar;
        barycentrics_vjp(map, n, b, b_bar, map_bar, n_bar);
        const Vec2 moved = -1 * pixel_vjp(view_.camera, n, n_bar);
        grad_.pixels.template add<2>(pixel, &moved.x);
    }

    const BackwardView<T>& view_;
    LocalGradients& grad_;
    std::vector<double> adjoint_, in_pixel_;
    CornerGrad corners_;
    int64_t pixel_ = 0;
};

template <class T>
class InteriorRecorder final : public SurfaceAccumulation {
   public:
    InteriorRecorder(const BackwardView<T>& view, const Record& kept, SurfaceRecords& records)
        : view_(view), kept_(kept), records_(records) {
        records_.reserve(scatter_chunk);
    }

    bool wants(int, const SurfaceSample&) override { return true; }

    void add(int, const SurfaceSample& s, Vec2 n, bool visible) override {
        if (visible) add(s.face, s.x, n, s.weight);
    }

    bool begin_pixel(int64_t, double weight) override {
        weight_ = weight;
        return true;
    }
    void add_in_pixel(int32_t face, Vec2 n, Vec2 x) override { in_pixels_.push_back({face, x, n, weight_}); }

    // Adds the samples face by face, so that data which samples of one face share is read and written once.
    void finish() override {
        std::stable_sort(in_pixels_.begin(), in_pixels_.end(),
                         [](const InPixel& a, const InPixel& b) { return a.face < b.face; });
        for (const InPixel& s : in_pixels_) add(s.face, s.x, s.n, s.weight);
    }

   private:
    struct InPixel {
        int32_t face;
        Vec2 x, n;
        double weight;
    };

    void add(int32_t face, Vec2 x, Vec2 n, double weight) {
        records_.face.push_back(face);
        append(records_.x, {x.x, x.y});
        append_ray(view_.camera, n, records_.along, kept_.intrinsics ? &records_.along_by_k : nullptr);
        records_.weight.push_back(weight);
    }

    const BackwardView<T>& view_;
    const Record kept_;
    SurfaceRecords& records_;
    double weight_ = 0;
    std::vector<InPixel> in_pixels_;
};

}  // namespace

template <class T>
std::unique_ptr<SurfaceAccumulation> accumulate_surfaces(const BackwardView<T>& view, const Accumulation& accumulation,
                                                         const GradientSink& to, LocalGradients& grad) {
    using Made = std::unique_ptr<SurfaceAccumulation>;
    if (const Reverse* c = std::get_if<Reverse>(&accumulation))
        return dispatch_channels(view.scene.channels, view.scene.channels > view.scene.radiance, [&]<int N>() -> Made {
            return std::make_unique<ReverseInterior<N, T>>(view, c->geometry, to, grad);
        });
    if (const Forward* c = std::get_if<Forward>(&accumulation))
        return std::make_unique<ForwardInterior<T>>(view, c->directions, grad);
    if (const Record* c = std::get_if<Record>(&accumulation))
        return std::make_unique<InteriorRecorder<T>>(view, *c, grad.records.surface);
    return std::make_unique<ScreenInterior<T>>(view, grad);
}

template std::unique_ptr<SurfaceAccumulation> accumulate_surfaces(const BackwardView<float>&, const Accumulation&,
                                                                  const GradientSink&, LocalGradients&);
template std::unique_ptr<SurfaceAccumulation> accumulate_surfaces(const BackwardView<double>&, const Accumulation&,
                                                                  const GradientSink&, LocalGradients&);

}  // namespace edgegrad
