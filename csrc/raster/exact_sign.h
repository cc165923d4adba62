// Computes signs of determinants that are correct despite rounding (Shewchuk 1997). It tries floating point with an
// error bound first, and exact arithmetic where that is undecided.
#pragma once

#include "core/math.h"

namespace edgegrad {

// Returns the sign, 1, 0 or −1, of x · (a × b), rows of finite doubles.
int exact_sign(Vec3 x, Vec3 a, Vec3 b);

// Returns the sign of u x − v y.
int exact_sign(double u, double x, double v, double y);

// Holds the line through a and b in the image, homogeneous. The sign of n · p says on which side p lies. Exchanging a
// and b negates everything to the bit.
struct ImageLine {
    Vec3 n;
    double doubt;  // n · p has the right sign where it exceeds this, for |p.x|, |p.y| and p.z up to 1.
};

inline ImageLine image_line(Vec3 a, Vec3 b) {
    const double yz = a.y * b.z, zy = a.z * b.y, zx = a.z * b.x, xz = a.x * b.z, xy = a.x * b.y, yx = a.y * b.x;
    // Each product, difference and sum rounds once, and so do the coordinates of p: six roundings at most in a row.
    constexpr double bound = 8 * 0x1p-53;
    const double size = std::fabs(yz) + std::fabs(zy) + std::fabs(zx) + std::fabs(xz) + std::fabs(xy) + std::fabs(yx);
    return {{yz - zy, zx - xz, xy - yx}, bound * size};
}

// Returns the side of the line through a and b on which the point p lies, all in homogeneous coordinates. A point on
// the line is moved by an infinitesimal to the right and a smaller one up (simulation of simplicity, Edelsbrunner and
// Mücke 1990). Returns 0 if a and b are one point of the image.
int side_of_line(Vec3 p, Vec3 a, Vec3 b);

}  // namespace edgegrad
