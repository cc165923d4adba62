// The lens of a panorama: longitude and latitude are the axes of the image (the equirectangular projection; see Snyder,
// Map Projections: A Working Manual, 1987, § 12).
#pragma once

#include <cmath>
#include <limits>
#include <optional>

#include "camera/cube_face.h"
#include "core/math.h"

namespace edgegrad {

// A panorama sees through the six sides of a cube around the eye (sub_cameras.h). Each has a frame of its own, in which
// it is a pinhole with |n.x|, |n.y| ≤ 1; this lens takes n to the panorama. Of the direction d = turnᵀ (n, 1) in the
// camera's frame, with h = hypot(d.x, d.z):
//
//     λ = atan2(d.x, d.z)    φ = atan2(d.y, h)    x = K (λ', φ', 1)
//
// A panorama may reach around more than once, or over a pole, where it goes on along the opposite meridian. So a
// direction has many places: with any integers i and j of one parity λ' = λ + j π, φ' = i π + (−1)ⁱ φ. A lens has one
// of these.
//
// K stands here, in place of coefficients: the camera's own only scales the undistorted image, so that m = x / scale.
class Equirectangular {
   public:
    static constexpr int coefficients = 6;  // the upper two rows of K
    // One of the places, and the angles (λ', φ') that this lens is for: below `to`, and not below `from`.
    struct Place {
        int across = 0, over = 0;  // j, i
        Vec2 from{-infinite, -infinite}, to{infinite, infinite};
    };

    Equirectangular(const double* K, const CubeFace& side, const Place& place);

    // The focal lengths of the undistorted image, px: positive areas stay positive.
    Vec2 scale() const { return scale_; }
    const double* K() const { return k_; }
    const CubeFace& side() const { return side_; }
    Mat3 turn() const { return side_.turn; }  // from the camera's frame to the side's
    // Whether there is a place around which areas grow as 1 / distance.
    bool has_pole() const { return side_.pole(); }

    Vec2 distort(Vec2 n) const;
    Mat2 jacobian(Vec2 n) const;
    void distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* k_bar) const;

    // The n that is seen at m, if it belongs to this side and place.
    std::optional<Vec2> undistort(Vec2 m) const;

    // The same for k points near m0, in place; not numbers where there is none.
    void undistort_near(Vec2 m0, int k, double* x, double* y) const;

    // False if no place within `reach` px of x belongs to this side and place.
    bool may_show(Vec2 x, double reach) const;

    // A box of pixel positions in which all is seen that lies in a box of n.
    Box2 image_box(Box2 n) const;
    // A box of n that holds all of this side and place that is seen in a box of pixel positions; none if nothing is.
    std::optional<Box2> side_box(Box2 x) const;

    // How much longer what lies in a box of n is in the image than in the undistorted image, about and at most, and how
    // much larger its area.
    double stretch(Box2 n) const;

    // λ' and φ' over a box of pixel positions, with those of its corners.
    static Box2 angles(const double* K, Box2 x);

   private:
    static constexpr double infinite = std::numeric_limits<double>::infinity();

    Vec2 angles_at(Vec3 d) const;
    Vec2 angles_of_pixel(Vec2 x) const;

    double k_[6], inverse_[4];
    CubeFace side_;
    Place place_;
    Vec2 scale_;
};

}  // namespace edgegrad
