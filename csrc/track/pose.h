// Defines the pose of an object in the camera's frame, and its steps.
#pragma once

#include <cmath>

#include "core/math.h"

namespace edgegrad {

inline Mat3 product(const Mat3& a, const Mat3& b) {
    Mat3 out;
    for (int i = 0; i < 3; ++i) out.row[i] = transposed_times(b, a.row[i]);
    return out;
}
inline Mat3 transpose(const Mat3& m) {
    const Vec3* r = m.row;
    return {{{r[0].x, r[1].x, r[2].x}, {r[0].y, r[1].y, r[2].y}, {r[0].z, r[1].z, r[2].z}}};
}

// Returns the rotation about w by |w| radians (Rodrigues), and its inverse for angles below pi.
inline Mat3 rotation_of(Vec3 w) {
    const double angle = length(w);
    // The series avoid 0 / 0; they are exact to double precision there.
    const double a = angle < 1e-4 ? 1 - angle * angle / 6 : std::sin(angle) / angle;
    const double b = angle < 1e-4 ? 0.5 - angle * angle / 24 : (1 - std::cos(angle)) / (angle * angle);
    const double xx = b * w.x * w.x, yy = b * w.y * w.y, zz = b * w.z * w.z;
    const double xy = b * w.x * w.y, yz = b * w.y * w.z, zx = b * w.z * w.x;
    return {{{1 - yy - zz, xy - a * w.z, zx + a * w.y},
             {xy + a * w.z, 1 - xx - zz, yz - a * w.x},
             {zx - a * w.y, yz + a * w.x, 1 - xx - yy}}};
}
inline Vec3 rotation_vector(const Mat3& R) {
    const Vec3 axis{R.row[2].y - R.row[1].z, R.row[0].z - R.row[2].x, R.row[1].x - R.row[0].y};
    const double sine = 0.5 * length(axis), cosine = 0.5 * (R.row[0].x + R.row[1].y + R.row[2].z - 1);
    const double angle = std::atan2(sine, cosine);
    return (sine < 1e-9 ? 0.5 : 0.5 * angle / sine) * axis;
}

// Places a point X of the mesh, relative to its centre, at q = R X + c.
struct RigidPose {
    Mat3 R{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    Vec3 c;

    Vec3 operator()(Vec3 X) const { return R * X + c; }
    // Returns a point or a direction of the camera's frame in that of the mesh.
    Vec3 to_mesh(Vec3 q) const { return transposed_times(R, q - c); }
    Vec3 direction_to_mesh(Vec3 d) const { return transposed_times(R, d); }

    // Returns the pose after the step d = (w, t): R <- exp([w]x) R, c <- c + size t.
    RigidPose stepped(const double d[6], double size) const {
        return {product(rotation_of({d[0], d[1], d[2]}), R), c + size * Vec3{d[3], d[4], d[5]}};
    }
};

// Adds the derivative of value . q by the step, for q = R X + c with arm = R X: value . (w x arm) = (arm x value) . w.
inline void step_gradient(Vec3 arm, double size, Vec3 value, double out[6]) {
    const Vec3 w = cross(arm, value);
    out[0] = w.x, out[1] = w.y, out[2] = w.z;
    out[3] = size * value.x, out[4] = size * value.y, out[5] = size * value.z;
}

}  // namespace edgegrad
