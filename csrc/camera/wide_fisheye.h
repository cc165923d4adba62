// Implements a fisheye lens that shows more than a half space, up to all around; see fisheye.h.
#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "camera/cube_face.h"
#include "camera/fisheye.h"
#include "core/math.h"

namespace edgegrad {

// It sees through the faces of a cube, as a panorama does (equirectangular.h). Its poles lie on its axis. With the
// camera's axes X, Y and Z, directions are d = (X, −Z, Y), so the angle to the axis is θ = φ + π/2, and
//
//     m = θ' (sin λ, cos λ)    θ' = θ (1 + k1 θ² + …)    x = K (m, 1).
//
// It ends at the lens boundary, where θ' is greatest, or where θ is π. At π, a whole circle is the one direction
// behind.
//
// The parameters are K, for the same reason as in a panorama, and k1 to k4.
class WideFisheye {
   public:
    static constexpr int coefficients = 6 + Fisheye::coefficients;

    // Makes the face ahead.
    WideFisheye(const double* K, const Fisheye& fisheye);
    // Returns another face of the same lens.
    WideFisheye through(const CubeFace& cube_face) const;

    Vec2 scale() const { return scale_; }
    const CubeFace& cube_face() const { return cube_face_; }
    Mat3 rotation() const;                                   // rotates from the camera's frame to the face's
    double lens_boundary() const { return lens_boundary_; }  // radians
    // Returns whether the antipode of the axis lies ahead, around which areas grow as 1 / distance.
    bool has_pole() const { return cube_face_.rotation.row[2].y > 0; }

    Vec2 distort(Vec2 n) const;
    Mat2 jacobian(Vec2 n) const;  // zero beyond the lens boundary
    void distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* c_bar) const;

    // These do what those of Equirectangular do.
    std::optional<Vec2> undistort(Vec2 m) const;
    bool may_show(Vec2 x, double reach) const;
    Box2 image_box(Box2 n) const;
    std::optional<Box2> cube_face_box(Box2 x) const;
    double stretch(Box2 n) const;

    // These return m of a lens boundary point, its derivative with respect to the image angle of e, and its direction.
    Vec2 lens_boundary_point(Vec2 e) const;
    Vec2 lens_boundary_tangent(Vec2 e) const;
    Vec3 lens_boundary_direction(Vec2 e) const { return direction_of(lens_boundary_, e); }

    // Returns whether some of a box of pixel positions lies beyond the lens boundary.
    bool ends_in(Box2 x) const;

   private:
    struct Polar {
        double angle;  // angle to the axis
        double sine;   // sine times the length of d
        Vec2 along;    // m / |m|, or zero on the axis
    };
    static Polar polar(Vec3 d);
    static Vec3 direction_of(double angle, Vec2 along);
    Vec2 m_of_pixel(Vec2 x) const;
    Vec2 scaled(Vec2 m) const;  // returns K m over the scale
    // These return the angle at which |m| is m, or the lens boundary beyond, and quick bounds below and above it.
    double angle(double m) const;
    double angle_below(double m) const;
    double angle_above(double m) const;

    double k_[6], inverse_[4];
    Fisheye fisheye_;
    CubeFace cube_face_;
    Vec2 scale_;
    double lens_boundary_, reach_;                       // θ and θ' at the boundary
    std::shared_ptr<const std::vector<double>> angles_;  // taken at equal steps of |m| up to the reach
};

}  // namespace edgegrad
