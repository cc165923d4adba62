// A control variate for creases, as control.h is one for faces: what a crease would give if all of it were visible.
//
// Its radiance is known on both sides, so with τ = x_b − x_a, the jump ΔL = L₋ − L₊, affine between the ends, and φ_a =
// 1 − s, φ_b = s the boundary term would be
//
//     Σ_k δx_k ∧ τ ∫ Ã(x(s)) · ΔL(s) φ_k(s) ds,   k in {a, b}.
//
// Between the lines where the pixel filter begins and ends, Ã is a constant (box) or a quadratic of s (tent), so
// Gauss's rule gives the integral exactly; of a Gaussian the quadratic through three points of each piece serves. That
// is added for all such creases, and its integrand taken away at each sample, so that nothing is biased; samples find
// only where the crease is occluded after all.
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

// Of one curve after the other.
class CreaseControl {
   public:
    virtual ~CreaseControl() = default;

    // Begins with a curve; false where there is no control.
    virtual bool set(const Curve& curve) = 0;
    // How much the sides of that curve differ: Σ_c weight_c |jump_c|, the mean of both ends. Or of any two faces
    // without texture, after which no curve has begun.
    virtual double jump(const std::vector<double>& weights) const = 0;
    virtual double jump_between(const HalfEdge& minus, const HalfEdge& plus, const std::vector<double>& weights) = 0;
    // What its density is multiplied by, if a short crease gets `least`.
    virtual double density(double least) const = 0;

    virtual void add_integral() = 0;
    // At the fraction s of the curve, of a sample with this weight.
    virtual void subtract(double s, double weight) = 0;
    // The cotangents of the places of the ends, half to each face's own vertices.
    virtual void flush(RowBuffer& x) = 0;
};

template <class T>
std::unique_ptr<CreaseControl> make_crease_control(const BackwardView<T>& view);

}  // namespace edgegrad
