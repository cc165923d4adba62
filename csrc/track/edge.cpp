#include "track/edge.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

using Settings = TrackSettings;

constexpr double window = 3, window_weight = 7;  // px: pixels near the edge count; what all of them count for together
// The trends' prior has the information of `window_weight` pixels in a channel; both count in each of three as
// residuals do.
constexpr double shrinkage = window_weight / (1 + window_weight);
const double trend_factor =
    std::pow(1 + window_weight, -0.5 * 6 * Settings::edge_exponent / (0.5 * (3 * window_weight - 6)));

}  // namespace

EdgeModel::EdgeModel() : basis_() {
    for (int k = 0; k < 2; ++k) {
        Basis& basis = basis_[k];
        for (int d = 0; d < distances; ++d) {
            double column[4][pixels], weight[pixels], sum = 0;
            for (int j = 0; j < pixels; ++j) {
                const double x = j - Settings::across - distance(d);
                weight[j] = std::exp(-0.5 * x * x / (window * window)), sum += weight[j];
            }
            for (int j = 0; j < pixels; ++j) {
                const double x = j - Settings::across - distance(d);
                const double phi = 0.5 * std::erfc(-x / (Settings::blur[k] * std::sqrt(2.0)));
                weight[j] *= window_weight / sum;
                const double root = std::sqrt(weight[j]);
                column[0][j] = root * (1 - phi), column[1][j] = root * phi;
                column[2][j] = root * (1 - phi) * x / window, column[3][j] = root * phi * x / window;
            }
            for (int i = 0; i < 4; ++i) {  // Gram and Schmidt, twice for the rounding
                for (int again = 0; again < 2; ++again)
                    for (int m = 0; m < i; ++m) {
                        double along = 0;
                        for (int j = 0; j < pixels; ++j) along += column[i][j] * column[m][j];
                        for (int j = 0; j < pixels; ++j) column[i][j] -= along * column[m][j];
                    }
                double square = 0;
                for (int j = 0; j < pixels; ++j) square += column[i][j] * column[i][j];
                for (int j = 0; j < pixels; ++j) column[i][j] /= std::sqrt(square);
            }
            for (int j = 0; j < pixels; ++j) {
                basis.weight[j][d] = float(weight[j]);
                for (int i = 0; i < 4; ++i) basis.column[i][j][d] = float(std::sqrt(weight[j]) * column[i][j]);
            }
        }
    }
}

EDGEGRAD_VECTORIZED void EdgeModel::add_likelihoods(const Basis& basis, const float (*I)[4], float (*out)[padded]) {
    alignas(32) float constant[padded] = {}, trend[padded] = {};
    for (int c = 0; c < 3; ++c) {
        alignas(32) float along[4][padded] = {};
        for (int j = 0; j < pixels; ++j) {
            const float v = I[j][c], square = v * v;
            for (int d = 0; d < padded; ++d) {
                constant[d] += basis.weight[j][d] * square;
                along[0][d] += basis.column[0][j][d] * v;
                along[1][d] += basis.column[1][j][d] * v;
                along[2][d] += basis.column[2][j][d] * v;
                along[3][d] += basis.column[3][j][d] * v;
            }
        }
        for (int d = 0; d < padded; ++d) {
            constant[d] -= along[0][d] * along[0][d] + along[1][d] * along[1][d];
            trend[d] += along[2][d] * along[2][d] + along[3][d] * along[3][d];
        }
    }
    static_assert(Settings::edge_exponent == 3, "cubes below");
    constexpr float noise = float(Settings::edge_noise), shrunk = float(shrinkage);
    const float factor = float(trend_factor);
    for (int d = 0; d < padded; ++d) {
        const float c = std::max(constant[d], 0.f) + noise, t = std::max(constant[d] - shrunk * trend[d], 0.f) + noise;
        out[0][d] += 1 / (c * c * c), out[1][d] += factor / (t * t * t);
    }
}

void EdgeModel::evaluate(const float (*I)[4], const SideModels& models, bool moving, float* out, double* shares) const {
    // The mean is taken away first, which the model contains: floats then hold small residuals of bright pixels.
    float J[pixels][4], mean[4] = {};
    for (int j = 0; j < pixels; ++j)
        for (int c = 0; c < 4; ++c) mean[c] += I[j][c] / float(pixels);
    for (int j = 0; j < pixels; ++j)
        for (int c = 0; c < 4; ++c) J[j][c] = I[j][c] - mean[c];
    alignas(32) float sum[SideModels::count][padded] = {};
    add_likelihoods(basis_[0], J, sum);
    if (moving) add_likelihoods(basis_[1], J, sum);
    double all[SideModels::count], total = 0;
    for (int k = 0; k < SideModels::count; ++k) {
        all[k] = 0;
        for (int d = 0; d < distances; ++d) all[k] += sum[k][d];
        total += all[k] *= models.probability[k];
    }
    for (int k = 0; k < SideModels::count; ++k) shares[k] += all[k] / total;
    for (int d = 0; d < distances; ++d) {
        double p = 0;
        for (int k = 0; k < SideModels::count; ++k) p += models.probability[k] * double(sum[k][d]);
        out[d] = float(p);
    }
}

void EdgeModel::evaluate(const Frame& frame, const ContourPoint& point, const SideModels& models, bool moving,
                         float* out, double* shares) const {
    float I[pixels][4];
    for (int j = 0; j < pixels; ++j) frame.sample(0, point.x + double(j - Settings::across) * point.n, I[j]);
    evaluate(I, models, moving, out, shares);
}

}  // namespace edgegrad
