// Implements OpenCV's lens model: radial and decentring distortion (Brown 1966, Conrady 1919) with a rational radial
// part.
#pragma once

#include <cmath>
#include <vector>

#include "core/math.h"
#include "core/polynomial.h"

namespace edgegrad {

// Distorts n to m. With s = |n|² and g = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³):
//
//     m = g n + (2 p1 n.x n.y + p2 (s + 2 n.x²), p1 (s + 2 n.y²) + 2 p2 n.x n.y)
struct BrownConrady {
    static constexpr int coefficients = 8;  // in OpenCV's order, whose shorter lists are prefixes
    double k1, k2, p1, p2, k3, k4, k5, k6;

    explicit BrownConrady(const double* c)
        : k1(c[0]), k2(c[1]), p1(c[2]), p2(c[3]), k3(c[4]), k4(c[5]), k5(c[6]), k6(c[7]) {}

    Vec2 distort(Vec2 n) const {
        const double xx = n.x * n.x, yy = n.y * n.y, s = xx + yy, xy2 = 2 * n.x * n.y, g = above(s) / below(s);
        return {n.x * g + (p1 * xy2 + p2 * (s + 2 * xx)), n.y * g + (p1 * (s + 2 * yy) + p2 * xy2)};
    }

    Mat2 jacobian(Vec2 n) const {
        const double s = n.x * n.x + n.y * n.y, g = above(s) / below(s), g2 = 2 * slope(s, g);
        const double across = g2 * n.x * n.y + 2 * (p1 * n.x + p2 * n.y);
        return {g + g2 * n.x * n.x + 2 * p1 * n.y + 6 * p2 * n.x, across, across,
                g + g2 * n.y * n.y + 6 * p1 * n.y + 2 * p2 * n.x};
    }

    void distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* c_bar) const {
        n_bar += transposed_times(jacobian(n), bar);
        const double xx = n.x * n.x, yy = n.y * n.y, s = xx + yy, xy2 = 2 * n.x * n.y, b = below(s), g = above(s) / b;
        const double g_bar = (bar.x * n.x + bar.y * n.y) / b, b_bar = -g * g_bar;
        c_bar[0] += g_bar * s, c_bar[1] += g_bar * s * s, c_bar[4] += g_bar * s * s * s;
        c_bar[2] += bar.x * xy2 + bar.y * (s + 2 * yy), c_bar[3] += bar.x * (s + 2 * xx) + bar.y * xy2;
        c_bar[5] += b_bar * s, c_bar[6] += b_bar * s * s, c_bar[7] += b_bar * s * s * s;
    }

    bool is_radial() const { return p1 == 0 && p2 == 0; }
    // Returns whether the lens is a pinhole.
    bool is_identity() const {
        for (const double c : {k1, k2, p1, p2, k3, k4, k5, k6})
            if (c != 0) return false;
        return true;
    }
    double radius(double r) const { return r * (above(r * r) / below(r * r)); }
    double radius_slope(double r) const {
        const double s = r * r, g = above(s) / below(s);
        return g + 2 * s * slope(s, g);
    }

    // r' = (A B + 2 s (A' B − A B')) / B², with g = A / B. The sign changes at the zeros of that numerator, of A, and
    // at poles.
    std::vector<double> turning_radii(double most) const {
        const Polynomial A{1, k1, k2, k3}, B{1, k4, k5, k6}, AB = product(A, B);
        Polynomial rise = AB;
        const Polynomial a = product({0, 2}, product(derivative(A), B)), b = product({0, 2}, product(A, derivative(B)));
        for (size_t i = 0; i < a.size(); ++i) rise[i] += a[i] - b[i];
        std::vector<double> out;
        for (const Polynomial& p : {rise, A, B})
            for (const double s : sign_changes(p, 0, most * most)) out.push_back(std::sqrt(s));
        return out;
    }

   private:
    double above(double s) const { return 1 + s * (k1 + s * (k2 + s * k3)); }
    double below(double s) const { return 1 + s * (k4 + s * (k5 + s * k6)); }
    // Returns ∂g/∂s.
    double slope(double s, double g) const {
        return (k1 + s * (2 * k2 + s * 3 * k3) - g * (k4 + s * (2 * k5 + s * 3 * k6))) / below(s);
    }
};

}  // namespace edgegrad
