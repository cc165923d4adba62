// Implements OpenCV's fisheye lens (Kannala and Brandt 2006). The radius is a polynomial of the angle to the axis.
#pragma once

#include <cmath>
#include <vector>

#include "core/math.h"
#include "core/polynomial.h"

namespace edgegrad {

// Distorts n to m = θ' n / |n|, with θ = atan |n| and θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸).
struct Fisheye {
    static constexpr int coefficients = 4;
    double k[4];

    explicit Fisheye(const double* c) : k{c[0], c[1], c[2], c[3]} {}

    Vec2 distort(Vec2 n) const {
        const double r = length(n);
        return (r > tiny ? radius(r) / r : 1) * n;
    }

    // Returns g I + (g'/r) n nᵀ with g = θ'/r.
    Mat2 jacobian(Vec2 n) const {
        const double r = length(n), g = r > tiny ? radius(r) / r : 1;
        const double h = r > tiny ? (radius_slope(r) - g) / (r * r) : 0;
        return {g + h * n.x * n.x, h * n.x * n.y, h * n.x * n.y, g + h * n.y * n.y};
    }

    void distort_vjp(Vec2 n, Vec2 bar, Vec2& n_bar, double* c_bar) const {
        n_bar += transposed_times(jacobian(n), bar);
        const double r = length(n), angle = std::atan(r);
        double power = r > tiny ? (bar.x * n.x + bar.y * n.y) / r * angle : 0;
        for (int i = 0; i < 4; ++i) c_bar[i] += power *= angle * angle;
    }

    static bool is_radial() { return true; }
    double radius(double r) const { return at_angle(std::atan(r)); }
    double radius_slope(double r) const { return slope_at_angle(std::atan(r)) / (1 + r * r); }
    std::vector<double> turning_radii(double most) const {
        std::vector<double> out = turning_angles(std::atan(most));
        for (double& angle : out) angle = std::tan(angle);
        return out;
    }

    // These return θ', its derivative with respect to θ, and where that changes its sign.
    double at_angle(double angle) const {
        const double s = angle * angle;
        return angle * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))));
    }
    double slope_at_angle(double angle) const {
        const double s = angle * angle;
        return 1 + s * (3 * k[0] + s * (5 * k[1] + s * (7 * k[2] + s * 9 * k[3])));
    }
    std::vector<double> turning_angles(double most) const {
        std::vector<double> out = sign_changes({1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]}, 0, most * most);
        for (double& s : out) s = std::sqrt(s);
        return out;
    }

   private:
    static constexpr double tiny = 1e-9;  // At a smaller r, θ' is r to double precision.
};

}  // namespace edgegrad
