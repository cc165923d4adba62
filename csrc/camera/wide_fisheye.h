// The lens of a fisheye that shows more than a half space, up to all around: see fisheye.h.
#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "camera/cube_face.h"
#include "camera/fisheye.h"
#include "core/math.h"

namespace edgegrad {

// It sees through the sides of a cube, as a panorama does (equirectangular.h). Its poles lie on its axis: with the
// camera's axes X, Y and Z, directions are d = (X, −Z, Y), so that the angle to the axis is θ = φ + π/2, and
//
//     m = θ' (sin λ, cos λ)    θ' = θ (1 + k1 θ² + …)    x = K (m, 1).
//
// It ends at the lens boundary, where θ' is greatest, or where θ is π: there all of a circle is the one direction
// behind.
//
// Parameters are K, for the reason that a panorama has, and k1 to k4.
class WideFisheye {
   public:
    static constexpr int coefficients = 6 + Fisheye::coefficients;

    // The side ahead.
    WideFisheye(const double* K, const Fisheye& fisheye);
    // Another one of the same lens.
    WideFisheye through(const CubeFace& side) const;

    Vec2 scale() const { return scale_; }
    const CubeFace& side() const { return side_; }
    Mat3 turn() const;                                       // from the camera's frame to the side's
    double lens_boundary() const { return lens_boundary_; }  // radians
    // Whether the antipode of the axis lies ahead, around which areas grow as 1 / distance.
    bool has_pole() const { return side_.turn.row[2].y > 0; }

    Vec2 distort(Vec2 n) const;
    Mat2 jacobian(Vec2 n) const;  // zero beyond the lens boundary
    void distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* c_bar) const;

    // As those of Equirectangular.
    std::optional<Vec2> undistort(Vec2 m) const;
    bool may_show(Vec2 x, double reach) const;
    Box2 image_box(Box2 n) const;
    std::optional<Box2> side_box(Box2 x) const;
    double stretch(Box2 n) const;

    // The m of a point of the lens boundary, its derivative by the angle of e in the image, and its direction.
    Vec2 lens_boundary_point(Vec2 e) const;
    Vec2 lens_boundary_tangent(Vec2 e) const;
    Vec3 lens_boundary_direction(Vec2 e) const { return direction_of(lens_boundary_, e); }

    // Whether some of a box of pixel positions lies beyond the lens boundary.
    bool ends_in(Box2 x) const;

   private:
    struct Polar {
        double angle;  // to the axis
        double sine;   // times the length of d
        Vec2 along;    // m / |m|; zero on the axis
    };
    static Polar polar(Vec3 d);
    static Vec3 direction_of(double angle, Vec2 along);
    Vec2 m_of_pixel(Vec2 x) const;
    Vec2 scaled(Vec2 m) const;  // K m over the scale
    // The angle at which |m| is such; the lens boundary beyond. And angles below and above it, at once.
    double angle(double m) const;
    double angle_below(double m) const;
    double angle_above(double m) const;

    double k_[6], inverse_[4];
    Fisheye fisheye_;
    CubeFace side_;
    Vec2 scale_;
    double lens_boundary_, reach_;                       // θ there, and θ'
    std::shared_ptr<const std::vector<double>> angles_;  // at equal steps of |m| up to the reach
};

}  // namespace edgegrad
