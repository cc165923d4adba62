#include "track/lines.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

using Settings = TrackSettings;

// The grid's spacing limits how well a distance is known, in segments and px.
constexpr double coarse_deviation = 0.3, exact_deviation = 0.1;

// Writes n^T dx/dd, the derivative of a point's position along its normal by the step.
void normal_gradient(const SeenPoint& seen, Vec2 n, Vec3 arm, double size, double J[6]) {
    step_gradient(arm, size, n.x * seen.dx + n.y * seen.dy, J);
}

}  // namespace

LineDistance LineTerm::combine(const RegionEvidence& region, int segment, double gate, const float* edge) {
    constexpr int distances = RegionEvidence::distances;
    double p[distances], all = 0, within = 0, sum = 0, mean = 0, square = 0;
    const float most = *std::max_element(region.log, region.log + distances);
    // Something that covers the object ends elsewhere, and says nothing about its contour. The mixture of both has the
    // share of the information that lies within the gate.
    const double least_gate = edge ? Settings::edge_reach + 0.5 * segment : 1.5 * segment;
    gate = edge ? least_gate : std::max(gate, least_gate);
    for (int k = 0; k < distances; ++k) {
        p[k] = std::exp(double(region.log[k] - most)), all += p[k];
        if (std::abs(k - Settings::reach) * segment <= gate) within += p[k];
        else p[k] = 0;
    }
    const auto add = [&](double probability, double d) {
        sum += probability, mean += probability * d, square += probability * d * d;
    };
    if (edge) {
        float largest = 0;
        for (int i = 0; i < EdgeModel::distances; ++i) largest = std::max(largest, edge[i]);
        for (int i = 0; i < EdgeModel::distances; ++i) {
            const double d = EdgeModel::distance(i), at = d / segment + Settings::reach;
            const int k = std::clamp(int(at), 0, distances - 2);
            const double share = at - k, log = (1 - share) * region.log[k] + share * region.log[k + 1];
            add(std::exp(log - most) * double(edge[i] / largest) + 1e-300, d);
        }
    } else {
        for (int k = 0; k < distances; ++k) add(p[k], double(segment) * (k - Settings::reach));
    }
    if (!(within > 0)) return {0, 1, -1, 0};
    mean /= sum;
    const double least = edge ? exact_deviation : coarse_deviation * segment;
    return {float(mean), float(std::max(square / sum - mean * mean, 0.0) + least * least),
            region.known ? region.gain : -1.f, float(within / all)};
}

// A model keeps a share of the probability, so that it can come back when the light changes.
void LineTerm::learn_models() {
    double all = 0;
    for (const double share : shares_) all += share;
    if (!(all > 0)) return;
    constexpr double rate = Settings::model_rate, least = Settings::least_model;
    for (int k = 0; k < SideModels::count; ++k) {
        const double share = (1 - SideModels::count * least) * shares_[k] / all + least;
        models.probability[k] += rate * (share - models.probability[k]);
    }
}

void LineTerm::measure(const Frame& frame, ColorHistograms& histograms, const TrackCamera& camera,
                       const PosedMesh& object, std::span<const ContourPoint> points, const LineScale& scale) {
    points_.assign(points.begin(), points.end()), distances_.clear();
    std::fill(shares_, shares_ + SideModels::count, 0.0);
    outline_ = points.size();
    for (const ContourPoint& p : points) {
        const RegionEvidence region = region_.evaluate(frame, histograms, p, scale.segment);
        float edge[EdgeModel::distances];
        if (scale.exact) {
            double J[6], along = 0;
            if (const auto seen = camera.project(object.pose(p.X)))
                normal_gradient(*seen, p.n, object.pose.R * p.X, object.mesh->size(), J);
            else std::fill(J, J + 6, 0.0);
            for (int k = 0; k < 6; ++k) along += J[k] * scale.velocity[k];
            double shares[SideModels::count] = {};
            edge_.evaluate(frame, p, models, std::fabs(along) > Settings::moving, edge, shares);
            if (region.known && region.gain > 0.5f)
                for (int k = 0; k < SideModels::count; ++k) shares_[k] += shares[k];
        }
        distances_.push_back(combine(region, scale.segment, scale.gate, scale.exact ? edge : nullptr));
    }
}

void LineTerm::measure_sharp(const Frame& frame, std::span<const ContourPoint> points) {
    constexpr double none = Settings::no_edge;
    for (const ContourPoint& p : points) {
        float edge[EdgeModel::distances];
        double unused[SideModels::count] = {};
        edge_.evaluate(frame, p, models, false, edge, unused);
        double all = 0, sum = 0, mean = 0, square = 0;
        for (const float v : edge) all += v;
        for (int i = 0; i < EdgeModel::distances; ++i) {
            const double v = edge[i] / all + none / EdgeModel::distances, d = EdgeModel::distance(i);
            sum += v, mean += v * d, square += v * d * d;
        }
        mean /= sum;
        points_.push_back(p);
        distances_.push_back(
            {float(mean), float(square / sum - mean * mean + exact_deviation * exact_deviation), 1, 1});
    }
}

void LineTerm::add(const TrackCamera& camera, const PosedMesh& object, double cauchy, NormalEquations& to) const {
    for (size_t i = 0; i < points_.size(); ++i) {
        const ContourPoint& p = points_[i];
        const LineDistance& d = distances_[i];
        if (!d.shows_edge()) continue;
        const auto seen = camera.project(object.pose(p.X));
        if (!seen) continue;
        double J[6];
        normal_gradient(*seen, p.n, object.pose.R * p.X, object.mesh->size(), J);
        const Vec2 moved = seen->x - p.x;
        const double residual = d.mean - (moved.x * p.n.x + moved.y * p.n.y), r = residual / cauchy;
        to.add(J, residual, d.share / (d.variance * (1 + r * r)));
    }
}

double LineTerm::residual(const TrackCamera& camera, const PosedMesh& object) const {
    double sum = 0, n = 0;
    for (size_t i = 0; i < points_.size(); ++i) {
        const ContourPoint& p = points_[i];
        const LineDistance& d = distances_[i];
        if (!d.shows_edge()) continue;
        const auto x = camera.position(object.pose(p.X));
        if (!x) continue;
        const Vec2 moved = *x - p.x;
        const double r = d.mean - (moved.x * p.n.x + moved.y * p.n.y);
        sum += d.share * r * r / d.variance, n += d.share;
    }
    return n > 0 ? std::sqrt(sum / n) : 0;
}

}  // namespace edgegrad
