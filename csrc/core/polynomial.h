// Evaluates polynomials of one variable, Σ cᵢ xⁱ.
#pragma once

#include <vector>

namespace edgegrad {

using Polynomial = std::vector<double>;

inline double value_at(const Polynomial& c, double x) {
    double sum = 0;
    for (size_t i = c.size(); i-- > 0;) sum = sum * x + c[i];
    return sum;
}

inline Polynomial derivative(const Polynomial& c) {
    Polynomial out;
    for (size_t i = 1; i < c.size(); ++i) out.push_back(double(i) * c[i]);
    return out;
}

inline Polynomial product(const Polynomial& a, const Polynomial& b) {
    Polynomial out(a.size() + b.size() - 1, 0.0);
    for (size_t i = 0; i < a.size(); ++i)
        for (size_t j = 0; j < b.size(); ++j) out[i + j] += a[i] * b[j];
    return out;
}

// Returns where c changes its sign in [low, high], ascending. It bisects between the derivative's zeros.
inline std::vector<double> sign_changes(const Polynomial& c, double low, double high) {
    if (c.size() < 2) return {};
    std::vector<double> stops = sign_changes(derivative(c), low, high), out;
    stops.insert(stops.begin(), low), stops.push_back(high);
    for (size_t i = 1; i < stops.size(); ++i) {
        double a = stops[i - 1], b = stops[i];
        const bool rises = value_at(c, a) < 0;
        if (rises == (value_at(c, b) < 0)) continue;
        for (int j = 0; j < 100; ++j) {
            const double middle = 0.5 * (a + b);
            ((value_at(c, middle) < 0) == rises ? a : b) = middle;
        }
        out.push_back(0.5 * (a + b));
    }
    return out;
}

}  // namespace edgegrad
