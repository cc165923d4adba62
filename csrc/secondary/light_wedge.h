// This file clips a light's triangle to the part from which an edge is a silhouette: the wedges between the planes of
// its faces.
//
// Coordinates are the triangle's last two barycentrics. A plane is a line in them, and areas are fractions of twice the
// unit triangle's. A face's height over a point of the light is affine, so its values at the corners determine it. The
// edge is a silhouette from where all heights, signed as the faces run along the edge, agree in sign.
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

#include "core/math.h"

namespace edgegrad {

class LightWedge {
   public:
    // Sets the wedges from the heights of the edge's faces at the corners of the triangle.
    void clip(std::span<const Vec3> heights) {
        along_ = {1, 0};
        for (const Vec3 h : heights) {
            // The long axis of a wedge is the line of a face's plane.
            const Vec2 across{h.y - h.x, h.z - h.x};
            const double size = length(across);
            if (!(size > 0)) continue;
            along_ = {-across.y / size, across.x / size};
            break;
        }
        for (int k = 0; k < 2; ++k) {
            std::vector<Vec2>& polygon = polygon_[k];
            polygon.clear(), area_[k] = 0, sections_[k].clear();
            const double side = k ? -1 : 1;
            if (std::any_of(heights.begin(), heights.end(),
                            [&](Vec3 h) { return std::max({side * h.x, side * h.y, side * h.z}) <= 0; }))
                continue;
            polygon = {{0, 0}, {1, 0}, {0, 1}};
            for (const Vec3 h : heights)
                if (std::min({side * h.x, side * h.y, side * h.z}) < 0) cut(polygon, side * h);
            for (size_t i = 2; i < polygon.size(); ++i) {
                const Vec2 p = polygon[i - 1] - polygon[0], q = polygon[i] - polygon[0];
                area_[k] += std::max(p.x * q.y - p.y * q.x, 0.0);
            }
        }
    }

    // Sets the wedge to the whole triangle.
    void all() {
        along_ = {1, 0};
        for (int k = 0; k < 2; ++k) polygon_[k].clear(), area_[k] = 0, sections_[k].clear();
        polygon_[0] = {{0, 0}, {1, 0}, {0, 1}}, area_[0] = 1;
    }

    // Returns the wedges' fraction of the triangle's area.
    double fraction() const { return area_[0] + area_[1]; }

    // Returns a point in the middle of the larger wedge, which must not be empty.
    Vec2 centre() const {
        const std::vector<Vec2>& polygon = polygon_[area_[1] > area_[0]];
        Vec2 sum;
        for (const Vec2 p : polygon) sum = sum + p;
        return (1 / double(polygon.size())) * sum;
    }

    struct Point {
        Vec2 uv;
        int side;  // side of the edge on which its faces lie
    };
    // Maps numbers in [0, 1) to uniform points. The first number ascends along the wedge, in proportion to its area.
    Point at(double along, double across) {
        double area = along * fraction();
        const int k = area_[0] > 0 && (area < area_[0] || !(area_[1] > 0)) ? 0 : 1;
        if (k) area -= area_[0];
        if (sections_[k].empty()) find_sections(polygon_[k], sections_[k]);
        const Section s = section(sections_[k], std::clamp(area / area_[k], 0.0, 1.0));
        const double c = s.low + across * (s.high - s.low);
        const Vec2 uv{s.at * along_.x - c * along_.y, s.at * along_.y + c * along_.x};
        const double u = std::clamp(uv.x, 0.0, 1.0);
        return {{u, std::clamp(uv.y, 0.0, 1 - u)}, k ? -1 : 1};
    }

   private:
    struct Section {
        double at = 0, low = 0, high = 0;
    };

    // Keeps the part with a positive height (Sutherland and Hodgman 1974).
    void cut(std::vector<Vec2>& polygon, Vec3 h) {
        kept_.clear();
        const auto height = [&](Vec2 p) { return (1 - p.x - p.y) * h.x + p.x * h.y + p.y * h.z; };
        for (size_t i = 0; i < polygon.size(); ++i) {
            const Vec2 p = polygon[i], q = polygon[(i + 1) % polygon.size()];
            const double at_p = height(p), at_q = height(q);
            if (at_p >= 0) kept_.push_back(p);
            if ((at_p > 0 && at_q < 0) || (at_p < 0 && at_q > 0)) kept_.push_back(p + (at_p / (at_p - at_q)) * (q - p));
        }
        polygon.swap(kept_);
    }

    // Collects the sections across a convex polygon at its corners, in ascending order.
    void find_sections(const std::vector<Vec2>& polygon, std::vector<Section>& sections) const {
        const auto forward = [&](Vec2 p) { return p.x * along_.x + p.y * along_.y; };
        const auto aside = [&](Vec2 p) { return p.y * along_.x - p.x * along_.y; };
        for (const Vec2 p : polygon) sections.push_back({forward(p), aside(p), aside(p)});
        std::sort(sections.begin(), sections.end(), [](const Section& a, const Section& b) { return a.at < b.at; });
        for (Section& s : sections)
            for (size_t i = 0; i < polygon.size(); ++i) {
                const Vec2 p = polygon[i], q = polygon[(i + 1) % polygon.size()];
                const double at_p = forward(p), at_q = forward(q);
                if ((at_p < s.at) == (at_q < s.at) && at_p != s.at && at_q != s.at) continue;
                const double f = at_p == at_q ? 0 : (s.at - at_p) / (at_q - at_p),
                             c = aside(p) + f * (aside(q) - aside(p));
                s.low = std::min(s.low, c), s.high = std::max(s.high, c);
            }
    }

    // Returns the section that has the fraction `part` of the polygon's area before it.
    static Section section(const std::vector<Section>& sections, double part) {
        double total = 0;
        for (size_t j = 1; j < sections.size(); ++j) total += between(sections[j - 1], sections[j]);
        double area = part * total;
        size_t j = 1;
        while (j + 1 < sections.size() && area > between(sections[j - 1], sections[j]))
            area -= between(sections[j - 1], sections[j]), ++j;
        const Section &a = sections[j - 1], &b = sections[j];
        const double whole = between(a, b), f = whole > 0 ? std::clamp(area / whole, 0.0, 1.0) : 0.5;
        // In a trapezoid with the widths w₀, w₁ the area up to x is w₀ x + (w₁ − w₀) x² / 2.
        const double w0 = a.high - a.low, w1 = b.high - b.low,
                     root = std::sqrt(std::max(w0 * w0 + f * (w1 * w1 - w0 * w0), 0.0));
        const double x = w0 + root > 0 ? f * (w0 + w1) / (w0 + root) : f;
        return {a.at + x * (b.at - a.at), a.low + x * (b.low - a.low), a.high + x * (b.high - a.high)};
    }
    static double between(const Section& a, const Section& b) {
        return 0.5 * (a.high - a.low + b.high - b.low) * (b.at - a.at);
    }

    std::vector<Vec2> polygon_[2], kept_;  // one for either side of the edge
    double area_[2] = {0, 0};
    Vec2 along_;
    std::vector<Section> sections_[2];  // empty until `at` is called
};

}  // namespace edgegrad
