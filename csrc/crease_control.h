// A control variate for creases, as control.h is one for faces: what a short crease that is seen whole would give if
// the adjoint and the radiance on both its sides were affine along it.
//
// With ends a and b in the image, τ = x_b − x_a, the filtered adjoint Ã_i there and the jump ΔL_j = L₋ − L₊, the
// integral ∫ Ã · ΔL (δx ∧ τ) ds over s in (0, 1) would be
//
//     Σ_ijk w_ijk (Ã_i · ΔL_j) (δx_k ∧ τ),   i, j, k in {a, b},   w = ∫ φ_i φ_j φ_k ds = ¼ if i = j = k, else 1/12
//
// with φ_a = 1 − s and φ_b = s. It is added for all such creases, and its integrand is taken away at each sample, so
// that nothing is biased, whatever it is worth.
#pragma once

#include <algorithm>
#include <cmath>

#include "curve.h"
#include "interior.h"

namespace edgegrad {

// Rows of the colours on both sides of a crease at its ends.
template <class T>
struct CreaseColors {
    const T *minus[2], *plus[2];

    CreaseColors(const SceneView<T>& scene, const Curve& c) {
        const auto row = [&](const HalfEdge& h, int corner) {
            return scene.colors + int64_t(scene.corners[3 * int64_t(h.face) + corner]) * scene.channels;
        };
        minus[0] = row(c.minus, c.minus.first()), minus[1] = row(c.minus, c.minus.second());
        plus[0] = row(c.plus, c.plus.first()), plus[1] = row(c.plus, c.plus.second());
    }
    double jump(int end, int channel) const { return double(minus[end][channel]) - plus[end][channel]; }
    double size(int end, int channels) const {
        double sum = 0;
        for (int c = 0; c < channels; ++c) sum += std::fabs(jump(end, c));
        return sum;
    }
};

template <class T>
bool joins_colors(const SceneView<T>& scene, const Curve& c) {
    return c.is_crease() && !is_textured(scene, c.minus.face) && !is_textured(scene, c.plus.face);
}

template <int N, class T>
class CreaseControl {
   public:
    explicit CreaseControl(const BackwardView<T>& view) : view_(view), C_(N ? N : view.scene.channels) {}

    // Begins with a curve; false where there is no control.
    bool set(const Curve& curve) {
        const SceneView<T>& scene = view_.scene;
        if (!joins_colors(scene, curve) || curve.t0 > 0 || curve.t1 < 1 || !(curve.length <= longest)) return false;
        // A crease that comes near the eye is not affine in the image.
        if (!(std::max(curve.w0, curve.w1) < 2 * std::min(curve.w0, curve.w1))) return false;
        const auto minus = view_.hits->of(scene.faces + 3 * int64_t(curve.minus.face));
        const auto plus = view_.hits->of(scene.faces + 3 * int64_t(curve.plus.face));
        if (!minus.whole || !plus.whole) return false;
        clear_ = minus.clear && plus.clear;
        curve_ = &curve, tangent_ = curve.tangent();
        for (int k = 0; k < 2; ++k) {
            vertex_[0][k] = vertex(scene, curve.minus, k ? curve.minus.second() : curve.minus.first());
            vertex_[1][k] = vertex(scene, curve.plus, k ? curve.plus.second() : curve.plus.first());
            adjoint_[k] = view_.vertex_adjoint.data() + int64_t(vertex_[0][k]) * C_;
        }
        const CreaseColors<T> colors(scene, curve);
        aa_ = ab_ = ba_ = bb_ = 0;
        const int C = N ? N : C_;
        for (int c = 0; c < C; ++c) {
            const double ja = colors.jump(0, c), jb = colors.jump(1, c);
            aa_ += adjoint_[0][c] * ja, ab_ += adjoint_[0][c] * jb;
            ba_ += adjoint_[1][c] * ja, bb_ += adjoint_[1][c] * jb;
        }
        at_a_ = at_b_ = 0;
        return true;
    }

    // What its density is multiplied by: fewer samples where the adjoint hardly changes along it.
    double density() const {
        if (!clear_) return 1;
        const Vec2 middle = curve_->position(0.5);
        const auto pixel = [](double x, int count) {
            return int64_t(std::clamp(std::floor(x), 0.0, double(count - 1)));
        };
        const T* inside = view_.adjoint.of(pixel(middle.y, view_.camera.height) * view_.camera.width +
                                           pixel(middle.x, view_.camera.width));
        double sum = 0, change = 0;
        for (int c = 0; c < C_; ++c) {
            const double a = adjoint_[0][c], b = adjoint_[1][c];
            sum += std::fabs(a) + std::fabs(b);
            change = change + std::fabs(b - a) + std::fabs(2 * inside[c] - a - b);
        }
        if (!(sum > 0)) return 1;
        return std::clamp(std::max(rough * change / sum, curve_->length / wide), least, 1.0);
    }

    void add_integral() {
        at_a_ += 0.25 * aa_ + (1.0 / 12) * (ab_ + ba_ + bb_);
        at_b_ += 0.25 * bb_ + (1.0 / 12) * (aa_ + ab_ + ba_);
    }

    // At the fraction s of the curve, of a sample with this weight.
    void subtract(double s, double weight) {
        const double r = 1 - s, value = weight * (r * (r * aa_ + s * ab_) + s * (r * ba_ + s * bb_));
        at_a_ -= r * value, at_b_ -= s * value;
    }

    // The cotangents of the places of the ends, half to each face's own vertices.
    void flush(RowBuffer& x) {
        for (const auto& vertices : vertex_)
            for (int k = 0; k < 2; ++k) {
                const double half = 0.5 * (k ? at_b_ : at_a_);
                const Vec2 x_bar{half * tangent_.y, -half * tangent_.x};
                x.template add<2>(vertices[k], &x_bar.x);
            }
    }

   private:
    // px: from `wide` on a crease gets all its samples, from `longest` on its ends say little of what is between.
    static constexpr double least = 1.0 / 64, wide = 128, longest = 64, rough = 0.25;

    const BackwardView<T>& view_;
    const int C_;
    const Curve* curve_ = nullptr;
    Vec2 tangent_;
    bool clear_ = false;
    int32_t vertex_[2][2];  // of minus and plus; a and b
    const T* adjoint_[2];
    double aa_ = 0, ab_ = 0, ba_ = 0, bb_ = 0;  // Ã_i · ΔL_j
    double at_a_ = 0, at_b_ = 0;
};

}  // namespace edgegrad
