// Signs of determinants, right whatever rounding does (Shewchuk 1997): first in floating point with a bound of its
// error, then, where that leaves the sign open, exactly.
#pragma once

#include "core/math.h"

namespace edgegrad {

// x · (a × b) of which the sign is 1, 0 or −1; rows of finite doubles.
int exact_sign(Vec3 x, Vec3 a, Vec3 b);

// u x − v y
int exact_sign(double u, double x, double v, double y);

// The line through a and b in the image, homogeneous: the sign of n · p says on which side p lies. With a and b
// exchanged all is negated to the bit.
struct ImageLine {
    Vec3 n;
    double doubt;  // n · p has the right sign where it is larger, for |p.x|, |p.y| and p.z up to 1
};

inline ImageLine image_line(Vec3 a, Vec3 b) {
    const double yz = a.y * b.z, zy = a.z * b.y, zx = a.z * b.x, xz = a.x * b.z, xy = a.x * b.y, yx = a.y * b.x;
    // Each product, difference and sum rounds once, and so do the coordinates of p: six roundings at most in a row.
    constexpr double bound = 8 * 0x1p-53;
    const double size = std::fabs(yz) + std::fabs(zy) + std::fabs(zx) + std::fabs(xz) + std::fabs(xy) + std::fabs(yx);
    return {{yz - zy, zx - xz, xy - yx}, bound * size};
}

// The side of the line through a and b on which the point p lies, both in homogeneous coordinates; if it lies on the
// line, the side of p moved by an infinitesimal to the right and a smaller one up (simulation of simplicity,
// Edelsbrunner and Mücke 1990). 0 if a and b are one point of the image.
int side_of_line(Vec3 p, Vec3 a, Vec3 b);

}  // namespace edgegrad
