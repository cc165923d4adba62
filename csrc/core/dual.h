// Implements numbers and vectors with a derivative in one direction (forward-mode automatic differentiation). Code
// written for S = double computes its _jvp with S = Dual.
#pragma once

#include <cmath>

#include "core/math.h"

namespace edgegrad {

// Dual overloads these.
using std::cos;
using std::log2;
using std::sqrt;

struct Dual {
    double value = 0, dot = 0;

    Dual() = default;
    Dual(double v, double d = 0) : value(v), dot(d) {}
};

inline Dual operator+(Dual a, Dual b) { return {a.value + b.value, a.dot + b.dot}; }
inline Dual operator-(Dual a, Dual b) { return {a.value - b.value, a.dot - b.dot}; }
inline Dual operator-(Dual a) { return {-a.value, -a.dot}; }
inline Dual operator*(Dual a, Dual b) { return {a.value * b.value, a.dot * b.value + a.value * b.dot}; }
inline Dual operator/(Dual a, Dual b) {
    const double ratio = a.value / b.value;
    return {ratio, (a.dot - ratio * b.dot) / b.value};
}
inline Dual& operator+=(Dual& a, Dual b) { return a = a + b; }
inline Dual& operator*=(Dual& a, Dual b) { return a = a * b; }
inline Dual sqrt(Dual a) {
    const double root = std::sqrt(a.value);
    return {root, a.dot / (2 * root)};
}
inline Dual log2(Dual a) { return {std::log2(a.value), a.dot / (M_LN2 * a.value)}; }
inline Dual cos(Dual a) { return {std::cos(a.value), -std::sin(a.value) * a.dot}; }

struct DualVec3 {
    Vec3 value, dot;

    DualVec3() = default;
    DualVec3(Vec3 v, Vec3 d = {}) : value(v), dot(d) {}
};

inline DualVec3 operator+(DualVec3 a, DualVec3 b) { return {a.value + b.value, a.dot + b.dot}; }
inline DualVec3 operator-(DualVec3 a, DualVec3 b) { return {a.value - b.value, a.dot - b.dot}; }
inline DualVec3 operator*(Dual s, DualVec3 a) { return {s.value * a.value, s.dot * a.value + s.value * a.dot}; }
inline DualVec3 operator*(double s, DualVec3 a) { return {s * a.value, s * a.dot}; }
inline DualVec3& operator+=(DualVec3& a, DualVec3 b) { return a = a + b; }
inline Dual dot(DualVec3 a, DualVec3 b) { return {dot(a.value, b.value), dot(a.dot, b.value) + dot(a.value, b.dot)}; }
inline DualVec3 cross(DualVec3 a, DualVec3 b) {
    return {cross(a.value, b.value), cross(a.dot, b.value) + cross(a.value, b.dot)};
}
inline DualVec3 unit(DualVec3 m) { return {unit(m.value), unit_vjp(m.value, m.dot)}; }

// These return the value alone.
inline double plain(double a) { return a; }
inline double plain(Dual a) { return a.value; }
inline Vec3 plain(Vec3 a) { return a; }
inline Vec3 plain(DualVec3 a) { return a.value; }

// Maps a number type S to its vectors.
template <class S>
struct VectorOf;
template <>
struct VectorOf<double> {
    using type = Vec3;
};
template <>
struct VectorOf<Dual> {
    using type = DualVec3;
};
template <class S>
using Vector = typename VectorOf<S>::type;

inline Vec3 vector(double x, double y, double z) { return {x, y, z}; }
inline DualVec3 vector(Dual x, Dual y, Dual z) { return {{x.value, y.value, z.value}, {x.dot, y.dot, z.dot}}; }

// These clamp to bounds; the derivative is zero beyond them.
inline double clamped(double a, double low, double high) { return a < low ? low : a > high ? high : a; }
inline Dual clamped(Dual a, double low, double high) {
    return a.value < low ? Dual(low) : a.value > high ? Dual(high) : a;
}

}  // namespace edgegrad
