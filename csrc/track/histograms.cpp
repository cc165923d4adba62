#include "track/histograms.h"

#include <algorithm>

namespace edgegrad {

namespace {

using Settings = TrackSettings;

// The global pair has this much of an even spread, so that no colour is impossible.
constexpr float even = 0.02f;

}  // namespace

ColorHistograms::ColorHistograms(const TrackedMesh& mesh)
    : mesh_(mesh), state_(2 * size_t(Settings::centres + 1) * Frame::bins), whole_values_(2 * size_t(Frame::bins)) {
    whole_ = reinterpret_cast<Pair*>(whole_values_.data());
    seen_.reserve(2 * size_t(Settings::lines) * Settings::learnt);
    clear();
}

void ColorHistograms::clear() {
    std::fill(state_.begin(), state_.end(), 0.f);
    restore();
}

NearCentres ColorHistograms::near(Vec3 X) const {
    NearCentres out;
    double distance[Settings::nearest];
    int n = 0;
    for (int k = 0; k < Settings::centres; ++k) {
        const Vec3 d = X - mesh_.centres()[k];
        const double apart = dot(d, d);
        int at = n < Settings::nearest ? n++ : apart < distance[n - 1] ? n - 1 : -1;
        if (at < 0) continue;
        for (; at > 0 && distance[at - 1] > apart; --at) distance[at] = distance[at - 1], out[at] = out[at - 1];
        distance[at] = apart, out[at] = k;
    }
    return out;
}

void ColorHistograms::look_at(const NearCentres& centres) {
    backed_ = float(Settings::backoff);
    float sum[2] = {backed_, backed_};
    for (int k = 0; k < Settings::nearest; ++k) {
        at_[k] = local(centres[k]);
        for (int side = 0; side < 2; ++side) sum[side] += sum_[centres[k]][side];
    }
    for (int side = 0; side < 2; ++side) per_pixel_[side] = 1 / sum[side];
}

void ColorHistograms::begin_learning() { seen_.clear(); }

void ColorHistograms::learn(const NearCentres& centres, int bin, int side) {
    if (seen_.size() < seen_.capacity()) seen_.push_back({centres, bin, side});
}

// Each histogram h becomes h + rate (new - h), where a frame shows something new of it.
void ColorHistograms::end_learning(double rate) {
    bool any[Settings::centres][2] = {};
    for (const Seen& s : seen_)
        for (const int32_t k : s.centres) any[k][s.side] = true;
    const float kept = float(1 - rate), added = float(rate);
    for (int k = 0; k < Settings::centres; ++k) {
        const float scale[2] = {any[k][0] ? kept : 1.f, any[k][1] ? kept : 1.f};
        if (!any[k][0] && !any[k][1]) continue;
        Pair* h = local(k);
        for (int b = 0; b < Frame::bins; ++b) h[b][0] *= scale[0], h[b][1] *= scale[1];
    }
    Pair* whole = counts();
    for (int b = 0; b < Frame::bins; ++b) whole[b][0] *= kept, whole[b][1] *= kept;
    for (const Seen& s : seen_) {
        for (const int32_t k : s.centres) local(k)[s.bin][s.side] += added;
        whole[s.bin][s.side] += added;
    }
    restore();
}

void ColorHistograms::restore() {
    const auto sum_of = [](const Pair* h, float out[2]) {
        double sum[2] = {};
        for (int b = 0; b < Frame::bins; ++b) sum[0] += h[b][0], sum[1] += h[b][1];
        out[0] = float(sum[0]), out[1] = float(sum[1]);
    };
    for (int k = 0; k < Settings::centres; ++k) sum_of(local(k), sum_[k].data());
    float all[2];
    sum_of(counts(), all);
    for (int side = 0; side < 2; ++side) {
        const float scale = all[side] > 0 ? 1 / all[side] : 0;
        for (int b = 0; b < Frame::bins; ++b)
            whole_[b][side] = (scale * counts()[b][side] + even / Frame::bins) / (1 + even);
    }
}

}  // namespace edgegrad
