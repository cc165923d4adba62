// This file holds the lines past an edge that have all of its faces on one side. They fill the wedge (lune) between the
// planes of the faces that contains none of them. Along each of these lines, visibility between the two ends changes at
// the edge.
//
// Let e be the edge's unit direction, θ the angle to it and φ an angle about it. The lines have the directions e cos θ
// + sin θ (x cos φ + y sin φ) for φ in an interval. Each line counts once, whichever way it runs.
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <vector>

#include "core/math.h"

namespace edgegrad {

class Lune {
   public:
    Lune() = default;

    // Builds the lune of the edge from a to b. `opposite` has its faces' third corners; flat faces are ignored.
    Lune(Vec3 a, Vec3 b, std::span<const Vec3> opposite) {
        length_ = length(b - a);
        if (!(length_ > 0)) return;
        e_ = (1 / length_) * (b - a);
        std::vector<double> angles;
        for (const Vec3 o : opposite) {
            const Vec3 u = (o - a) - dot(o - a, e_) * e_;
            const double size = length(u);
            if (!(size > flat * length(o - a))) continue;
            if (angles.empty()) x_ = (1 / size) * u, y_ = cross(e_, x_);
            angles.push_back(std::atan2(dot(u, y_), dot(u, x_)));
        }
        if (angles.empty()) return;
        std::sort(angles.begin(), angles.end());
        // The widest gap between faces must leave more than half of all directions.
        double widest = angles.front() + 2 * M_PI - angles.back();
        low_ = angles.back();
        for (size_t i = 1; i < angles.size(); ++i)
            if (angles[i] - angles[i - 1] > widest) widest = angles[i] - angles[i - 1], low_ = angles[i - 1];
        width_ = widest - M_PI > flat ? widest - M_PI : 0;
    }

    // width() is in radians of azimuth; measure() is the width times the length of the edge.
    double width() const { return width_; }
    double measure() const { return length_ * width_; }
    bool empty() const { return !(measure() > 0); }

    // Maps numbers in [0, 1) to a direction with the pdf 2 sin θ / (π width) by solid angle. The faces lie where ((b −
    // a) × w) · (corner − a) < 0.
    Vec3 direction(double u, double v) const { return at(polar_angle(u), v); }
    Vec3 at(double theta, double v) const {
        const double phi = low_ + width_ * v;
        return std::cos(theta) * e_ + std::sin(theta) * (std::cos(phi) * x_ + std::sin(phi) * y_);
    }
    // Coordinates locate the line along w, oriented as at(θ, v) returns it. u is the fraction of the polar measure
    // below θ. v < 0 marks a line outside the lune.
    struct Coordinates {
        Vec3 w;
        double u, v = -1;
        bool is_there() const { return v >= 0; }
    };
    Coordinates locate(Vec3 w) const {
        if (!(width_ > 0)) return {};
        for (const double sign : {1.0, -1.0}) {
            const Vec3 l = sign * w;
            double turned = std::atan2(dot(l, y_), dot(l, x_)) - low_;
            turned -= 2 * M_PI * std::floor(turned / (2 * M_PI));
            if (turned > width_) continue;
            const double cosine = std::clamp(dot(l, e_), -1.0, 1.0), sine = length(cross(e_, l));
            const double theta = std::atan2(sine, cosine);
            return {l, (theta - sine * cosine) / M_PI, turned / width_};
        }
        return {};
    }
    // Returns the reciprocal of direction()'s pdf.
    double weight(Vec3 w) const { return M_PI / 2 * width_ / length(cross(e_, w)); }

    // Solves θ − sin θ cos θ = π u by Newton's method, safeguarded by bisection.
    static double polar_angle(double u) {
        double low = 0, high = M_PI, theta = M_PI * u;
        for (int k = 0; k < 40; ++k) {
            const double s = std::sin(theta), f = theta - s * std::cos(theta) - M_PI * u;
            if (std::fabs(f) < 1e-14) break;
            (f > 0 ? high : low) = theta;
            const double next = theta - f / (2 * s * s);
            theta = next > low && next < high ? next : 0.5 * (low + high);
        }
        return theta;
    }

   private:
    static constexpr double flat = 1e-9;  // radians by which coplanar faces may seem to fold

    Vec3 e_, x_, y_;
    double length_ = 0, low_ = 0, width_ = 0;
};

}  // namespace edgegrad
