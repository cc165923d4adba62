// Implements vectors and matrices in double precision, each operation followed by its reverse-mode derivative (_vjp). A
// _vjp takes the inputs and the cotangent of the output, and adds to the cotangents of the inputs.
#pragma once

#include <cmath>
#include <limits>

// Compiles a function twice, and selects by processor: loops over arrays gain from AVX2. ThreadSanitizer excludes it,
// because it would watch the selection, which runs before it is ready.
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__) && \
    !defined(__SANITIZE_THREAD__)
#define EDGEGRAD_VECTORIZED __attribute__((target_clones("avx2", "default")))
#else
#define EDGEGRAD_VECTORIZED
#endif

// Precedes a short loop over arrays. Not unrolled, the loop is vectorised as a whole.
#if defined(__GNUC__)
#define EDGEGRAD_ROLLED _Pragma("GCC unroll 1")
#else
#define EDGEGRAD_ROLLED
#endif

namespace edgegrad {

struct Vec2 {
    double x = 0, y = 0;
};

inline Vec2 operator+(Vec2 a, Vec2 b) { return {a.x + b.x, a.y + b.y}; }
inline Vec2 operator-(Vec2 a, Vec2 b) { return {a.x - b.x, a.y - b.y}; }
inline Vec2& operator+=(Vec2& a, Vec2 b) { return a = a + b; }
inline Vec2 operator*(double s, Vec2 a) { return {s * a.x, s * a.y}; }
inline double length(Vec2 a) { return std::sqrt(a.x * a.x + a.y * a.y); }

// Returns a ∧ b, twice the signed area of the triangle (0, a, b).
inline double wedge(Vec2 a, Vec2 b) { return a.x * b.y - a.y * b.x; }

struct Vec3 {
    double x = 0, y = 0, z = 0;
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec3& operator+=(Vec3& a, Vec3 b) { return a = a + b; }
inline Vec3& operator-=(Vec3& a, Vec3 b) { return a = a - b; }

inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline void dot_vjp(Vec3 a, Vec3 b, double bar, Vec3& a_bar, Vec3& b_bar) {
    a_bar += bar * b;
    b_bar += bar * a;
}

inline Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
// Uses bar · (δa × b + a × δb) = δa · (b × bar) + δb · (bar × a).
inline void cross_vjp(Vec3 a, Vec3 b, Vec3 bar, Vec3& a_bar, Vec3& b_bar) {
    a_bar += cross(b, bar);
    b_bar += cross(bar, a);
}

inline double length(Vec3 a) { return std::sqrt(dot(a, a)); }

// Returns m / |m|, or zero where there is no direction.
inline Vec3 unit(Vec3 m) {
    const double size = length(m);
    return size > 0 ? 1 / size * m : Vec3{};
}
// Returns δn = (δm − n (n · δm)) / |m|. The map is symmetric, so this is the _jvp, too.
inline Vec3 unit_vjp(Vec3 m, Vec3 bar) {
    const double size = length(m);
    if (!(size > 0)) return {};
    const Vec3 n = 1 / size * m;
    return 1 / size * (bar - dot(n, bar) * n);
}

// Bounds the rounding error of a · (b × c).
inline double rounding_of_triple_product(Vec3 a, Vec3 b, Vec3 c) {
    const auto sum = [](Vec3 v) { return std::fabs(v.x) + std::fabs(v.y) + std::fabs(v.z); };
    return 4 * std::numeric_limits<double>::epsilon() * sum(a) * sum(b) * sum(c);
}

struct Mat2 {
    double xx, xy, yx, yy;
};

inline Vec2 operator*(const Mat2& m, Vec2 v) { return {m.xx * v.x + m.xy * v.y, m.yx * v.x + m.yy * v.y}; }
inline Vec2 transposed_times(const Mat2& m, Vec2 v) { return {m.xx * v.x + m.yx * v.y, m.xy * v.x + m.yy * v.y}; }
inline double determinant(const Mat2& m) { return m.xx * m.yy - m.xy * m.yx; }
inline Mat2 inverse(const Mat2& m) {
    const double s = 1 / determinant(m);
    return {s * m.yy, -s * m.xy, -s * m.yx, s * m.xx};
}
// Returns m⁻¹ v.
inline Vec2 solve(const Mat2& m, Vec2 v) { return inverse(m) * v; }

struct Mat3 {
    Vec3 row[3];
};

inline Vec3 operator*(const Mat3& m, Vec3 v) { return {dot(m.row[0], v), dot(m.row[1], v), dot(m.row[2], v)}; }

// Returns mᵀ v, which converts a cotangent of m p to one of p.
inline Vec3 transposed_times(const Mat3& m, Vec3 v) { return v.x * m.row[0] + v.y * m.row[1] + v.z * m.row[2]; }

inline Mat3 inverse(const Mat3& m) {
    const Vec3 a = m.row[0], b = m.row[1], c = m.row[2];
    const Vec3 bc = cross(b, c), ca = cross(c, a), ab = cross(a, b);  // columns of the adjugate
    const double s = 1.0 / dot(a, bc);
    return {{{s * bc.x, s * ca.x, s * ab.x}, {s * bc.y, s * ca.y, s * ab.y}, {s * bc.z, s * ca.z, s * ab.z}}};
}

}  // namespace edgegrad
