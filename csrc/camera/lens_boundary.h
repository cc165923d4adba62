// The lens boundary: the closed curve in the image where the lens folds or ends, beyond which there is
// background. It moves with K and the coefficients c alone.
//
// Of the disc |n| < ρ (lens.h) it is the image of n = ρ e, with e = (cos θ, sin θ):
//
//     x = K (m, 1),   m = bend(n),   δm = ∂m/∂c δc + ∂m/∂n e δρ.
//
// What is radial folds where ∂m/∂n e = 0, so that the second part is zero (the envelope theorem), and so it is where
// the disc ends at 88°. With decentring distortion the disc ends where det ∂m/∂n = 0 at one angle alone, n*, and
//
//     δρ = −(∂det/∂c δc) / (∂det/∂ρ)   at n*.
//
// A wide fisheye has m = θ' e at the angle θ of its boundary. There ∂θ'/∂θ = 0, or θ is π whatever c.
#pragma once

#include <array>
#include <optional>

#include "camera/camera.h"

namespace edgegrad {

class LensBoundary {
   public:
    // Of a camera, or of one of its sub-cameras, with lens_view.end.
    explicit LensBoundary(const Camera& camera);

    struct Point {
        Vec2 x, tangent;  // px, and dx/dθ
        Vec2 n;           // the last that is seen, in normalised image coordinates
    };
    // None where another sub-camera shows it.
    std::optional<Point> at(double angle) const;

    // The pixel position.
    Vec2 place(double angle) const { return curve_at(angle).x; }

    // A box of the curve between two angles; false if another sub-camera shows all of that.
    struct Arc {
        double from, to;
    };
    bool box(Arc arc, Vec2& low, Vec2& high) const;

    // Outwards in the image, as long as the tangent.
    Vec2 outward(Vec2 tangent) const { return (camera_.k_det > 0 ? 1.0 : -1.0) * Vec2{tangent.y, -tangent.x}; }

    // How a point at one angle moves, forwards and backwards.
    Vec2 velocity(const Point& p, const IntrinsicsGrad& dot) const;
    void velocity_vjp(const Point& p, Vec2 bar, IntrinsicsGrad& intrinsics) const;

   private:
    Point curve_at(double angle) const;  // without n

    const Camera& camera_;
    Vec2 half_;                                                     // of the box of all of it
    std::optional<std::array<double, most_coefficients>> fold_by_;  // ∂ρ/∂c; none if it is zero or does not matter
};

}  // namespace edgegrad
