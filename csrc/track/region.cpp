#include "track/region.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

using Settings = TrackSettings;

// Returns the bin at the distance r along a line, or -1 where it says nothing about its side.
int bin_on_line(const Frame& frame, const ContourPoint& p, float r) {
    if (!(r > -p.inside && r < p.outside)) return -1;
    const double x = p.x.x + r * p.n.x, y = p.x.y + r * p.n.y;
    if (!(x >= 0 && y >= 0 && x < frame.width() && y < frame.height())) return -1;
    return frame.bin(int(x), int(y));
}

}  // namespace

RegionModel::RegionModel() : h_() {
    for (int r = 0; r < segments; ++r)
        for (int d = 0; d < RegionEvidence::distances; ++d) {
            const double x = (r - segments / 2) - (d - Settings::reach);
            h_[r][d] = float(0.5 - Settings::amplitude * std::tanh(x / (2 * Settings::slope)));
        }
}

EDGEGRAD_VECTORIZED void RegionModel::multiply(const float (*h)[padded], const float* inside, float* product) {
    alignas(32) float p[padded];
    for (float& v : p) v = 1;
    for (int r = 0; r < segments; ++r) {
        const float f = inside[r], g = 1 - f, slope = f - g;
        for (int d = 0; d < padded; ++d) p[d] *= g + h[r][d] * slope;
    }
    std::copy(p, p + RegionEvidence::distances, product);
}

RegionEvidence RegionModel::evaluate(const float* inside) const {
    RegionEvidence out;
    float product[RegionEvidence::distances], most = -1e30f;
    multiply(h_, inside, product);
    for (int d = 0; d < RegionEvidence::distances; ++d) {
        out.log[d] = std::log(product[d]);  // at least 0.07 for each of 23 segments, which floats hold
        most = std::max(most, out.log[d]);
    }
    constexpr float right = float(0.5 + Settings::amplitude), wrong = float(0.5 - Settings::amplitude);
    float all_inside = 1, all_outside = 1, sum = 0;
    for (int r = 0; r < segments; ++r) {
        all_inside *= right * inside[r] + wrong * (1 - inside[r]);
        all_outside *= wrong * inside[r] + right * (1 - inside[r]);
    }
    for (const float log : out.log) sum += std::exp(log - most);
    out.gain = std::log(sum / RegionEvidence::distances) + most - std::log(std::max(all_inside, all_outside));
    out.known = true;
    return out;
}

RegionEvidence RegionModel::evaluate(const Frame& frame, ColorHistograms& histograms, const ContourPoint& point,
                                     int scale) const {
    histograms.look_at(histograms.near(point.X));
    float inside[segments];
    int near = 0, known = 0;
    for (int k = 0; k < segments; ++k) {
        float ratio = 0;
        for (int i = 0; i < scale; ++i) {
            const float r = float(k * scale + i) + 0.5f - 0.5f * float(segments * scale);
            const bool counts = std::fabs(r) < 6.0f * float(scale);
            near += counts;
            const int bin = bin_on_line(frame, point, r);
            if (bin < 0) {
                known += counts;
                continue;
            }
            const ColorEvidence color = histograms.evidence(bin);
            ratio += color.log_ratio;
            known += counts && color.known;
        }
        inside[k] = 1 / (1 + std::exp(-ratio));
    }
    RegionEvidence out = evaluate(inside);
    out.known = known > Settings::known_pixels * near;
    return out;
}

void learn_colors(const Frame& frame, std::span<const ContourPoint> points, double rate, ColorHistograms& histograms) {
    histograms.begin_learning();
    for (const ContourPoint& p : points) {
        const NearCentres near = histograms.near(p.X);
        for (int side = 0; side < 2; ++side)
            for (float r = 1.5f; r < float(Settings::learnt); r += 1)
                if (const int bin = bin_on_line(frame, p, side ? r : -r); bin >= 0) histograms.learn(near, bin, side);
    }
    histograms.end_learning(rate);
}

}  // namespace edgegrad
