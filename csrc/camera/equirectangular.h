// Implements the lens of a panorama, whose image axes are longitude and latitude: the equirectangular projection
// (Snyder, Map Projections: A Working Manual, 1987, § 12).
#pragma once

#include <cmath>
#include <limits>
#include <optional>

#include "camera/cube_face.h"
#include "core/math.h"

namespace edgegrad {

// A panorama uses the six faces of a cube around the eye (sub_cameras.h). Each has its own frame, in which it is a
// pinhole with |n.x|, |n.y| ≤ 1; this lens maps n to the panorama. For the direction d = turnᵀ (n, 1) in the camera's
// frame, with h = hypot(d.x, d.z):
//
//     λ = atan2(d.x, d.z)    φ = atan2(d.y, h)    x = K (λ', φ', 1)
//
// A panorama may reach around more than once, or over a pole, where it continues along the opposite meridian. A
// direction therefore has many positions: for integers i and j of one parity, λ' = λ + j π and φ' = i π + (−1)ⁱ φ. A
// lens has one of these branches.
//
// K takes the place of coefficients. The camera's own K only scales the undistorted image, so that m = x / scale.
class Equirectangular {
   public:
    static constexpr int coefficients = 6;  // upper two rows of K
    // Selects one of these positions by (i, j), and the angles (λ', φ') that this lens serves: below `to`, and not
    // below `from`.
    struct Branch {
        int across = 0, over = 0;  // j and i
        Vec2 from{-infinite, -infinite}, to{infinite, infinite};
    };

    Equirectangular(const double* K, const CubeFace& cube_face, const Branch& branch);

    // Returns the focal lengths of the undistorted image, px; they keep positive areas positive.
    Vec2 scale() const { return scale_; }
    const double* K() const { return k_; }
    const CubeFace& cube_face() const { return cube_face_; }
    Mat3 rotation() const { return cube_face_.rotation; }  // It rotates from the camera's frame to the face's.
    // Returns whether areas grow as 1 / distance around some point.
    bool has_pole() const { return cube_face_.pole(); }

    Vec2 distort(Vec2 n) const;
    Mat2 jacobian(Vec2 n) const;
    void distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* k_bar) const;

    // Returns the n that is seen at m, if it belongs to this face and position.
    std::optional<Vec2> undistort(Vec2 m) const;

    // Does the same for k points near m0, in place; points without n become NaN.
    void undistort_near(Vec2 m0, int k, double* x, double* y) const;

    // Returns false if no point within `reach` px of x belongs to this face and position.
    bool may_show(Vec2 x, double reach) const;

    // Returns a box of pixel positions that contains the image of a box of n.
    Box2 image_box(Box2 n) const;
    // Returns a box of n of all that a box of pixel positions shows of this face and position; none if nothing.
    std::optional<Box2> cube_face_box(Box2 x) const;

    // Returns how much lengths grow from the undistorted image to the image in a box of n, approximately and at most.
    // Areas grow by about the same factor.
    double stretch(Box2 n) const;

    // Bounds λ' and φ' over a box of pixel positions, by its corners.
    static Box2 angles(const double* K, Box2 x);

   private:
    static constexpr double infinite = std::numeric_limits<double>::infinity();

    Vec2 angles_at(Vec3 d) const;
    Vec2 angles_of_pixel(Vec2 x) const;

    double k_[6], inverse_[4];
    CubeFace cube_face_;
    Branch branch_;
    Vec2 scale_;
};

}  // namespace edgegrad
