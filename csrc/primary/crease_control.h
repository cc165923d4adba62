// This file declares the control variate of creases: the gradient of a crease if all of it were visible (control.h has
// that of faces).
//
// The radiance on both sides is known. Let τ = x_b − x_a, φ_a = 1 − s, φ_b = s, and let the jump ΔL = L₋ − L₊ be affine
// between the ends. The boundary term would then be
//
//     Σ_k δx_k ∧ τ ∫ Ã(x(s)) · ΔL(s) φ_k(s) ds,   k in {a, b}.
//
// Between the lines at which the pixel filter begins and ends, Ã is a constant (box) or a quadratic of s (tent).
// Gauss's rule then gives the exact integral. For a Gaussian, the quadratic through three points of each piece serves.
// The integral is added for all such creases, and each sample subtracts its integrand, so the estimate is unbiased.
// Samples then only find where the crease is occluded.
#pragma once

#include <memory>
#include <vector>

#include "accumulate/scatter.h"
#include "boundary/curve.h"
#include "estimator/view.h"
#include "shading/shade.h"

namespace edgegrad {

template <class T>
bool joins_colors(const SceneView<T>& scene, const Curve& c) {
    return c.is_crease() && !is_textured(scene, c.minus.face) && !is_textured(scene, c.plus.face) &&
           !alpha_masks_jump(scene, c.minus, c.plus);
}

// CreaseControl evaluates the control of one curve at a time.
class CreaseControl {
   public:
    virtual ~CreaseControl() = default;

    // Starts a curve. Returns false where it has no control.
    virtual bool set(const Curve& curve) = 0;
    // jump() returns the difference between the sides of that curve: Σ_c weight_c |jump_c|, averaged over both ends.
    // jump_between() takes any two faces without texture; no curve is started afterwards.
    virtual double jump(const std::vector<double>& weights) const = 0;
    virtual double jump_between(const HalfEdge& minus, const HalfEdge& plus, const std::vector<double>& weights) = 0;
    // Returns the factor on the curve's sample density, if a short crease gets `least`.
    virtual double density(double least) const = 0;

    virtual void add_integral() = 0;
    // Subtracts the integrand at the fraction s of the curve, for a sample with this weight.
    virtual void subtract(double s, double weight) = 0;
    // Adds the cotangents of the end positions, half to each face's own vertices.
    virtual void flush(RowBuffer& x) = 0;
};

template <class T>
std::unique_ptr<CreaseControl> make_crease_control(const BackwardView<T>& view);

}  // namespace edgegrad
