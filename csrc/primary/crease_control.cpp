#include "primary/crease_control.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <type_traits>

#include "core/channels.h"

namespace edgegrad {

namespace {

// CreaseJumps holds the differences between the sides of an untextured crease, for all channels and both ends. Where
// one face may be opaque without the other, it is no such crease.
template <int N, class T>
class CreaseJumps {
   public:
    explicit CreaseJumps(const BackwardView<T>& view)
        : scene_(N == 0 ? without_continuous(view.scene, view.geometry.topology()) : view.scene),
          first_(view.scene.channels - scene_.channels),
          C_(channels_of<N>(scene_)) {
        if constexpr (N == 0) value_.resize(2 * C_);
    }

    void set(const HalfEdge& minus, const HalfEdge& plus) {
        std::fill(value_.begin(), value_.end(), 0.0);
        add(minus, 1), add(plus, -1);
    }
    // Returns Σ_c weight_c |jump_c|, averaged over both ends.
    double size(const std::vector<double>& weights) const {
        double sum = 0;
        for (int c = 0; c < C_; ++c) sum += weights[first_ + c] * (std::fabs(value_[c]) + std::fabs(value_[C_ + c]));
        return 0.5 * sum;
    }
    // WeightedJumps holds Σ_c A_c jump_c at both ends, given A of all channels.
    struct WeightedJumps {
        double a = 0, b = 0;
    };
    WeightedJumps times(const T* A) const {
        WeightedJumps sum;
        for (int c = 0; c < C_; ++c) {
            const double own = A[first_ + c];
            sum.a += own * value_[c], sum.b += own * value_[C_ + c];
        }
        return sum;
    }

   private:
    void add(const HalfEdge& h, double sign) {
        const int first = h.first(), second = h.second();
        each_corner_value<N>(scene_, h.face, [&](int c, double c0, double c1, double c2) {
            const double value[3] = {c0, c1, c2};
            value_[c] += sign * value[first], value_[C_ + c] += sign * value[second];
        });
    }

    const SceneView<T> scene_;  // the scene with only the channels that may jump
    const int first_, C_;       // first of these channels, and their number
    std::conditional_t<N == 0, std::vector<double>, std::array<double, 2 * all_channels<N>>> value_{};
};

template <int N, class T>
class ControlOfChannels final : public CreaseControl {
   public:
    explicit ControlOfChannels(const BackwardView<T>& view) : view_(view), jumps_(view) {}

    bool set(const Curve& curve) override {
        const SceneView<T>& scene = view_.scene;
        if (!joins_colors(scene, curve) || curve.t0 > 0 || curve.t1 < 1) return false;
        // A crease near the eye moves in the image otherwise than its ends.
        distort_ = std::fabs(curve.w1 - curve.w0) / (curve.w0 + curve.w1);
        if (!(distort_ < 1.0 / 3)) return false;
        curve_ = &curve, tangent_ = curve.tangent();
        jumps_.set(curve.minus, curve.plus);
        for (int k = 0; k < 2; ++k) {
            vertex_[0][k] = vertex(scene, curve.minus, k ? curve.minus.second() : curve.minus.first());
            vertex_[1][k] = vertex(scene, curve.plus, k ? curve.plus.second() : curve.plus.first());
        }
        for (int k = 0; k < 2; ++k) per_[k] = 1 / (k ? tangent_.y : tangent_.x);
        at_a_ = at_b_ = 0;
        return true;
    }
    double jump(const std::vector<double>& weights) const override { return jumps_.size(weights); }
    double jump_between(const HalfEdge& minus, const HalfEdge& plus, const std::vector<double>& weights) override {
        jumps_.set(minus, plus);
        return jumps_.size(weights);
    }

    double density(double least) const override {
        return std::clamp(std::max(curve_->length / least_length, distort_), least, 1.0);
    }

    void add_integral() override {
        if (view_.image.filter.is_box()) return add_integral_of_box();
        for (double begin = 0; begin < 1;) {
            const double end = end_of_piece(begin);
            add_quadratic(Piece(*this, begin, end), begin, end);
            begin = end;
        }
    }

    void subtract(double s, double weight) override {
        double begin = 0, end = end_of_piece(0);
        while (end < s) begin = end, end = end_of_piece(begin);
        const double value = weight * Piece(*this, begin, end).at(s);
        at_a_ -= (1 - s) * value, at_b_ -= s * value;
    }

    void flush(RowBuffer& x) override {
        for (int k = 0; k < 2; ++k) {
            const bool copies = vertex_[0][k] != vertex_[1][k];
            const double value = (copies ? 0.5 : 1) * (k ? at_b_ : at_a_);
            const Vec2 x_bar{value * tangent_.y, -value * tangent_.x};
            for (int side = 0; side < (copies ? 2 : 1); ++side) x.template add<2>(vertex_[side][k], &x_bar.x);
        }
    }

   private:
    // A Piece is Ã · ΔL between two lines of the filter. Ã is quadratic through ends and middle, or constant (box).
    class Piece {
       public:
        Piece(ControlOfChannels& control, double begin, double end)
            : middle_(0.5 * (begin + end)), half_(0.5 * (end - begin)) {
            const bool box = control.view_.image.filter.is_box();
            for (int k = box ? 1 : 0; k < (box ? 2 : 3); ++k)
                control.view_.adjoint.around(control.curve_->position(middle_ + (k - 1) * half_),
                                             [&](const T* A, double weight) {
                                                 const auto [a, b] = control.jumps_.times(A);
                                                 a_[k] += weight * a, b_[k] += weight * b;
                                             });
            if (box) a_[0] = a_[2] = a_[1], b_[0] = b_[2] = b_[1];
        }
        double at(double s) const {
            const double r = half_ > 0 ? (s - middle_) / half_ : 0, low = 0.5 * r * (r - 1), high = 0.5 * r * (r + 1);
            const double a = low * a_[0] + (1 - r * r) * a_[1] + high * a_[2];
            const double b = low * b_[0] + (1 - r * r) * b_[1] + high * b_[2];
            return (1 - s) * a + s * b;
        }

       private:
        double middle_, half_, a_[3] = {}, b_[3] = {};  // Ã times the jump at either end of the curve
    };

    // PixelWalk walks the pixels that a curve passes along one axis. It leaves a pixel at `next`, then every `step`.
    struct PixelWalk {
        int64_t pixel;
        int by;
        double next, step;
        PixelWalk(double origin, double along, double per)
            : pixel(int64_t(along < 0 ? std::ceil(origin) - 1 : std::floor(origin))),
              by(along < 0 ? -1 : 1),
              next(along == 0 ? std::numeric_limits<double>::infinity()
                              : (double(along < 0 ? pixel : pixel + 1) - origin) * per),
              step(std::fabs(per)) {}
        void pass(double end) {
            if (next <= end) next += step, pixel += by;
        }
    };

    // Adds ∫ φ_k (φ_a a + φ_b b) ds over each pixel passed, where Ã is constant. a, b are Ã times the jump at the ends.
    void add_integral_of_box() {
        const int width = view_.camera.width, height = view_.camera.height;
        PixelWalk columns(curve_->x0.x, tangent_.x, per_[0]), rows(curve_->x0.y, tangent_.y, per_[1]);
        struct Moments {
            double s, s2, s3;  // ∫ ds, ∫ s ds, ∫ s² ds from 0 on
        } low{};
        double at_a = 0, at_b = 0;
        for (double begin = 0; begin < 1;) {
            const double end = std::min({columns.next, rows.next, 1.0});
            const Moments high{end, end * end / 2, end * end * end / 3};
            const int64_t i = columns.pixel, j = rows.pixel;
            columns.pass(end), rows.pass(end);
            if (i >= 0 && j >= 0 && i < width && j < height) {
                const auto [a, b] = jumps_.times(view_.adjoint.of(j * width + i));
                const double one = high.s - low.s, s = high.s2 - low.s2, s2 = high.s3 - low.s3;
                at_a += (one - 2 * s + s2) * a + (s - s2) * b;
                at_b += (s - s2) * a + s2 * b;
            }
            begin = end, low = high;
        }
        at_a_ += at_a, at_b_ += at_b;
    }

    // Adds the integral over a piece where Ã is a quadratic, by Gauss's rule with three points, exact up to degree 5.
    void add_quadratic(const Piece& piece, double begin, double end) {
        constexpr double node[3] = {-0.7745966692414834, 0, 0.7745966692414834},
                         weight[3] = {5. / 18, 8. / 18, 5. / 18};
        for (int j = 0; j < 3; ++j) {
            const double s = 0.5 * ((begin + end) + node[j] * (end - begin));
            const double value = weight[j] * (end - begin) * piece.at(s);
            at_a_ += (1 - s) * value, at_b_ += s * value;
        }
    }

    // Returns where the piece that begins at s ends: at the next line of the filter, or at 1. Lines are pixel borders
    // for a box, and pixel centres otherwise.
    double end_of_piece(double s) const {
        const double shift = view_.image.filter.is_box() ? 0 : 0.5;
        double end = 1;
        const auto meet = [&](double origin, double along, double per) {
            if (along == 0) return;
            // The next line lies at least a millionth of the curve ahead, as s may be rounded to before the last one.
            const double here = origin + (s + 1e-6) * along - shift;
            const double line = along > 0 ? std::floor(here) + 1 : std::ceil(here) - 1;
            end = std::min(end, (line + shift - origin) * per);
        };
        meet(curve_->x0.x, tangent_.x, per_[0]), meet(curve_->x0.y, tangent_.y, per_[1]);
        return std::max(end, s + 1e-6);
    }

    static constexpr double least_length = 1024;  // px, length from which a crease gets all samples

    const BackwardView<T>& view_;
    const Curve* curve_ = nullptr;
    Vec2 tangent_;
    double per_[2];  // 1 / tangent_
    double distort_ = 0;
    int32_t vertex_[2][2];  // vertices of minus and plus, at a and b
    double at_a_ = 0, at_b_ = 0;
    CreaseJumps<N, T> jumps_;
};

}  // namespace

template <class T>
std::unique_ptr<CreaseControl> make_crease_control(const BackwardView<T>& view) {
    return dispatch_channels(
        view.scene.channels, view.scene.channels > view.scene.radiance,
        [&]<int N>() -> std::unique_ptr<CreaseControl> { return std::make_unique<ControlOfChannels<N, T>>(view); });
}

template std::unique_ptr<CreaseControl> make_crease_control(const BackwardView<float>&);
template std::unique_ptr<CreaseControl> make_crease_control(const BackwardView<double>&);

}  // namespace edgegrad
