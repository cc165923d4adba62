// Describes the lens boundary: the closed curve in the image where the lens folds or ends. Beyond it there is
// background. It moves with K and the coefficients c alone.
//
// It is the image of the border n = ρ e of the disc |n| < ρ (lens.h), with e = (cos θ, sin θ):
//
//     x = K (m, 1),   m = distort(n),   δm = ∂m/∂c δc + ∂m/∂n e δρ.
//
// A radial lens folds where ∂m/∂n e = 0, so the second term is zero (the envelope theorem). It is zero as well where
// the disc ends at 88°. With decentring distortion, the disc ends where det ∂m/∂n = 0 at one angle alone, n*, and
//
//     δρ = −(∂det/∂c δc) / (∂det/∂ρ)   at n*.
//
// A wide fisheye has m = θ' e at the angle θ of its boundary. There ∂θ'/∂θ = 0, or θ is π independently of c.
#pragma once

#include <array>
#include <optional>

#include "camera/camera.h"

namespace edgegrad {

class LensBoundary {
   public:
    // Takes a camera or a sub-camera, with lens_view.end.
    explicit LensBoundary(const Camera& camera);

    struct Point {
        Vec2 x, tangent;  // px and dx/dθ
        Vec2 n;           // last visible n, in normalised image coordinates
    };
    // Returns none where another sub-camera shows the point.
    std::optional<Point> at(double angle) const;

    // Returns the pixel position.
    Vec2 place(double angle) const { return curve_at(angle).x; }

    // Bounds the curve between two angles by a box. Returns false if another sub-camera shows all of it.
    struct Arc {
        double from, to;
    };
    bool box(Arc arc, Vec2& low, Vec2& high) const;

    // Returns the outward normal in the image, as long as the tangent.
    Vec2 outward(Vec2 tangent) const { return (camera_.k_det > 0 ? 1.0 : -1.0) * Vec2{tangent.y, -tangent.x}; }

    // These return how a point at one angle moves, forwards, and add the cotangents, backwards.
    Vec2 velocity(const Point& p, const IntrinsicsGrad& dot) const;
    void velocity_vjp(const Point& p, Vec2 bar, IntrinsicsGrad& intrinsics) const;

   private:
    Point curve_at(double angle) const;  // leaves n unset

    const Camera& camera_;
    Vec2 half_;  // half the size of the whole curve's box
    // It is ∂ρ/∂c, unless that is zero or does not matter.
    std::optional<std::array<double, most_coefficients>> fold_by_;
};

}  // namespace edgegrad
