// This file holds the control variate of the interior term. It is the gradient of a small, wholly visible face if
// radiance and adjoint were affine on its image.
//
// Let λ_i be the barycentrics of a point in the image of the face, x_i and c_i the positions and colours of its
// corners, and A_i the filtered adjoint there. If radiance and adjoint were L(x) = Σ λ_i c_i and Ã(x) = Σ λ_i A_i, then
// with
//
//     T_i = ∫ λ_i Ã dx = area / 12 · (A_i + Σ_j A_j)        (C numbers)
//
// the interior term would be T_i for the colour c_i, and −∇L · T_i for the position x_i, with ∇L constant. The control
// is the integrand at a sample, λ_i(x) Ã(x). The integral plus the sum over samples of (integrand − control) has the
// same mean as the sum of the integrand, however good the control is. It is good where a face is small and visible, and
// its adjoint nearly affine: few samples suffice there. A face wrongly taken for visible adds noise of mean zero.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "camera/vertices.h"
#include "scene/scene.h"
#include "shading/shade.h"

namespace edgegrad {

// Control subtracts the control of one face at its samples. FaceLanes::integrate adds its integral.
template <int N, class T>
class Control {
   public:
    // `adjoint` is Ã at the vertices, (V, C).
    Control(const SceneView<T>& scene, const VertexView& vertices, const T* adjoint)
        : scene_(scene), vertices_(vertices), adjoint_(adjoint), C_(channels_of<N>(scene)) {
        if constexpr (N == 0) A_.resize(3 * C_), T_.resize(3 * C_);
    }

    // Starts a face that lies inside the view.
    void start(int64_t face) {
        const int C = channels();
        face_ = face, v_ = scene_.faces + 3 * face;
        for (int i = 0; i < 3; ++i)
            for (int c = 0; c < C; ++c) A_[i * C + c] = adjoint_[int64_t(v_[i]) * C + c];
        std::fill(T_.begin(), T_.end(), 0.0);
    }

    // Subtracts the control at a sample that stands for this share of the face's area.
    void subtract(Barycentrics lambda, double share) {
        const int C = channels();
        for (int c = 0; c < C; ++c) {
            const double A = lambda[0] * A_[c] + lambda[1] * A_[C + c] + lambda[2] * A_[2 * C + c];
            for (int i = 0; i < 3; ++i) T_[i * C + c] -= share * lambda[i] * A;
        }
    }

    // Adds to the cotangents of the corners' positions.
    //
    //     ∇L = ((c_1 − c_0) (x_2 − x_0)⊥ − (c_2 − c_0) (x_1 − x_0)⊥) / ((x_1 − x_0) ∧ (x_2 − x_0))
    //
    // is multiplied by the area before the division, so that thin faces are safe.
    void add_to_places(Vec2 x_bar[3]) const {
        const int C = channels();
        const Vec2 x0 = vertices_.x[v_[0]], e1 = vertices_.x[v_[1]] - x0, e2 = vertices_.x[v_[2]] - x0;
        const double half = wedge(e1, e2) < 0 ? -0.5 : 0.5;
        const auto add = [&](int c, double c0, double c1, double c2) {
            const double d1 = half * (c1 - c0), d2 = half * (c2 - c0);
            const Vec2 gradient{d1 * e2.y - d2 * e1.y, d2 * e1.x - d1 * e2.x};  // ∇L times the area
            for (int i = 0; i < 3; ++i) x_bar[i] += -T_[i * C + c] * gradient;
        };
        each_corner_value<N>(scene_, face_, add);
    }

    // Adds to the cotangents of the values at the corners.
    void add_to_corners(CornerGrad& bar) const {
        const int C = channels(), R = radiance_of<N>(scene_);
        const double a = area();
        for (int i = 0; i < 3; ++i) {
            for (int c = 0; c < R; ++c) bar.value[i * R + c] += a * T_[i * C + c];
            for (int c = R; c < C; ++c) bar.attributes[i * (C - R) + c - R] += a * T_[i * C + c];
        }
    }

   private:
    int channels() const { return N ? all_channels<N> : C_; }
    double area() const {
        const Vec2 x0 = vertices_.x[v_[0]];
        return 0.5 * std::fabs(wedge(vertices_.x[v_[1]] - x0, vertices_.x[v_[2]] - x0));
    }

    const SceneView<T>& scene_;
    const VertexView& vertices_;
    const T* adjoint_;
    const int C_;

    int64_t face_ = -1;
    const int32_t* v_ = nullptr;
    using Numbers = std::conditional_t<N == 0, std::vector<double>, std::array<double, 3 * all_channels<N>>>;
    Numbers A_{}, T_{};  // (3, C); T over the area
};

}  // namespace edgegrad
