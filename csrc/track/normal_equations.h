// Sums the Gauss-Newton system of a pose, and solves small symmetric systems.
#pragma once

#include <cmath>

namespace edgegrad {

// Factors a symmetric positive definite matrix, given by its lower triangle, in place (Cholesky). Returns false, and
// stops, where it is not positive.
template <int N>
bool factor(double (&A)[N][N]) {
    for (int j = 0; j < N; ++j) {
        double d = A[j][j];
        for (int k = 0; k < j; ++k) d -= A[j][k] * A[j][k];
        if (!(d > 0)) return false;
        const double root = std::sqrt(d);
        A[j][j] = root;
        for (int i = j + 1; i < N; ++i) {
            double t = A[i][j];
            for (int k = 0; k < j; ++k) t -= A[i][k] * A[j][k];
            A[i][j] = t / root;
        }
    }
    return true;
}

// Solves L L^T x = b in place, with the factor L.
template <int N>
void solve_factored(const double (&L)[N][N], double* b) {
    for (int i = 0; i < N; ++i) {
        for (int k = 0; k < i; ++k) b[i] -= L[i][k] * b[k];
        b[i] /= L[i][i];
    }
    for (int i = N; i-- > 0;) {
        for (int k = i + 1; k < N; ++k) b[i] -= L[k][i] * b[k];
        b[i] /= L[i][i];
    }
}

// Holds H = sum J^T J / var and g = sum J^T r / var of a log-likelihood -1/2 sum (r - J d)^2 / var.
struct NormalEquations {
    double H[6][6] = {};  // lower triangle
    double g[6] = {};

    void add(const double J[6], double residual, double information) {
        for (int a = 0; a < 6; ++a) {
            const double w = information * J[a];
            g[a] += w * residual;
            for (int b = 0; b <= a; ++b) H[a][b] += w * J[b];
        }
    }
    void add(const NormalEquations& o) {
        for (int a = 0; a < 6; ++a) {
            g[a] += o.g[a];
            for (int b = 0; b <= a; ++b) H[a][b] += o.H[a][b];
        }
    }
    // Adds a normal prior of the step about -offset with the same deviation in each entry.
    void add_prior(const double offset[6], double deviation) {
        const double known = 1 / (deviation * deviation);
        for (int a = 0; a < 6; ++a) H[a][a] += known, g[a] -= known * offset[a];
    }
    // Writes d = H^-1 g, and returns whether H is positive definite.
    bool solve(double d[6]) const {
        double L[6][6];
        for (int a = 0; a < 6; ++a)
            for (int b = 0; b <= a; ++b) L[a][b] = H[a][b];
        if (!factor(L)) return false;
        for (int a = 0; a < 6; ++a) d[a] = g[a];
        solve_factored(L, d);
        return true;
    }
    // Writes H^-1, row by row.
    bool invert(double out[36]) const {
        double L[6][6];
        for (int a = 0; a < 6; ++a)
            for (int b = 0; b <= a; ++b) L[a][b] = H[a][b];
        if (!factor(L)) return false;
        for (int a = 0; a < 6; ++a) {
            double e[6] = {};
            e[a] = 1;
            solve_factored(L, e);
            for (int b = 0; b < 6; ++b) out[6 * b + a] = e[b];
        }
        return true;
    }
};

}  // namespace edgegrad
