// This file finds where silhouettes and open borders pass before a crease in the image. Between these places all of it
// is visible or none, unless meshes intersect.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "boundary/curve.h"
#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"
#include "primary/coincident_segments.h"

namespace edgegrad {

// SilhouetteGrid holds segments in the cells of a grid over the image.
class SilhouetteGrid {
   public:
    // Takes silhouettes and borders, in parts.
    SilhouetteGrid(const std::vector<std::vector<ImageSegment>>& parts, int width, int height, ThreadTeam& team) {
        std::vector<int64_t> first(parts.size() + 1, 0);
        double total = 0;  // length
        for (size_t k = 0; k < parts.size(); ++k) {
            first[k + 1] = first[k] + int64_t(parts[k].size());
            for (const ImageSegment& s : parts[k]) total += length(s.b - s.a);
        }
        cell_ =
            std::max({2.0, std::sqrt(double(width) * height / 0x1p18), total / (4 * double(first.back()) + 0x1p16)});
        per_cell_ = 1 / cell_;
        columns_ = int(width * per_cell_) + 1, rows_ = int(height * per_cell_) + 1;
        begin_.assign(size_t(columns_) * rows_ + 1, 0);
        segments_ = Array<Segment>(first.back());
        const auto each_cell = [&](int64_t k, auto body) {
            for (size_t i = 0; i < parts[k].size(); ++i) {
                const Segment& s = segments_[first[k] + int64_t(i)];
                this->each_cell(s.a, s.b, float_reach + s.rounding, [&](size_t cell) {
                    body(std::atomic_ref(begin_[cell]), uint32_t(first[k] + int64_t(i)));
                    return true;
                });
            }
        };
        const int64_t n = int64_t(parts.size());
        team.parallel_for(n, [&](int64_t k) {
            for (size_t i = 0; i < parts[k].size(); ++i) {
                const ImageSegment& s = parts[k][i];
                segments_[first[k] + int64_t(i)] = {s.a, s.b, s.depth, s.rounding};
            }
            each_cell(k, [](std::atomic_ref<uint32_t> end, uint32_t) { end.fetch_add(1, std::memory_order_relaxed); });
        });
        uint32_t sum = 0;
        for (uint32_t& b : begin_) sum += std::exchange(b, sum);
        entries_ = Array<uint32_t>(sum);
        team.parallel_for(n, [&](int64_t k) {
            each_cell(k, [&](std::atomic_ref<uint32_t> end, uint32_t segment) {
                entries_[end.fetch_add(1, std::memory_order_relaxed)] = segment;
            });
        });
        // Each cell's begin has moved to its end, which is the begin of the next.
        for (size_t cell = begin_.size() - 1; cell > 0; --cell) begin_[cell] = begin_[cell - 1];
        begin_[0] = 0;
    }

    // Relation describes the segments that pass before a curve, or at most `touching` behind it. `apart`: none meets it
    // between its ends. `along`: one runs along it, closer than floats resolve. `across`: one may cross it.
    enum class Relation { apart, along, across };
    Relation relation(const Curve& c, double touching) const {
        const double farthest = std::max(c.a.z, c.b.z) + touching;
        Relation found = Relation::apart;
        each_cell(c.x0, c.x1, c.rounding, [&](size_t cell) {
            if (size(cell) > most_in_a_cell) found = Relation::across;
            else
                each_in(cell, [&](const Segment& s) {
                    if (s.depth <= farthest) found = std::max(found, relation(c, s));
                    return found != Relation::across;
                });
            return found != Relation::across;
        });
        return found;
    }

    // Returns whether a segment no farther than `farthest` passes a box of the image, within the error of rays.
    bool in(Vec2 low, Vec2 high, double farthest) const {
        const int i0 = index(low.x, columns_), i1 = index(high.x, columns_);
        const int j0 = index(low.y, rows_), j1 = index(high.y, rows_);
        if (int64_t(i1 - i0 + 1) * (j1 - j0 + 1) > most_cells) return true;
        for (int j = j0; j <= j1; ++j)
            for (int i = i0; i <= i1; ++i)
                if (!each_in(size_t(j) * columns_ + i,
                             [&](const Segment& s) { return s.depth > farthest || !passes(s, low, high); }))
                    return true;
        return false;
    }

   private:
    struct Segment {
        Vec2 a, b;
        double depth;  // depth of its nearer end
        double rounding;
    };

    uint32_t size(size_t cell) const { return begin_[cell + 1] - begin_[cell]; }

    // Calls body(segment) for the segments of a cell until it returns false. Returns whether it never did.
    template <class Body>
    bool each_in(size_t cell, Body body) const {
        for (uint32_t i = begin_[cell]; i < begin_[cell + 1]; ++i)
            if (!body(segments_[entries_[i]])) return false;
        return true;
    }

    static bool passes(const Segment& s, Vec2 low, Vec2 high) {
        const double margin = float_reach + s.rounding;
        const Vec2 middle = 0.5 * (low + high), half = 0.5 * (high - low) + Vec2{margin, margin};
        // A separating axis is x, y or the normal of the segment.
        const Vec2 to_a = s.a - middle, to_b = s.b - middle, along = s.b - s.a;
        return std::min(to_a.x, to_b.x) <= half.x && std::max(to_a.x, to_b.x) >= -half.x &&
               std::min(to_a.y, to_b.y) <= half.y && std::max(to_a.y, to_b.y) >= -half.y &&
               std::fabs(wedge(along, to_a)) <= std::fabs(along.x) * half.y + std::fabs(along.y) * half.x;
    }

    // Segments that meet the curve in an end are apart: they are silhouettes that continue from a vertex of a crease.
    static Relation relation(const Curve& c, const Segment& s) {
        const Vec2 along = s.b - s.a, own = c.tangent();
        const double error = 4 * (c.rounding + s.rounding), length = edgegrad::length(along);  // px
        const double d0 = wedge(along, c.x0 - s.a) / length, d1 = wedge(along, c.x1 - s.a) / length;
        if (std::max(std::fabs(d0), std::fabs(d1)) <= float_reach + error) {
            const double squared = c.length * c.length;
            const auto parameter = [&](Vec2 x) { return ((x.x - c.x0.x) * own.x + (x.y - c.x0.y) * own.y) / squared; };
            const double t0 = parameter(s.a), t1 = parameter(s.b);
            const double overlap = std::min(std::max(t0, t1), 1.0) - std::max(std::min(t0, t1), 0.0);
            return overlap > 1e-6 ? Relation::along : Relation::apart;
        }
        if (std::min(std::fabs(d0), std::fabs(d1)) <= error || (d0 > 0) == (d1 > 0)) return Relation::apart;
        const double e0 = wedge(own, s.a - c.x0) / c.length, e1 = wedge(own, s.b - c.x0) / c.length;
        return (e0 > error && e1 > error) || (e0 < -error && e1 < -error) ? Relation::apart : Relation::across;
    }

    // Calls body(cell) for every cell within `margin` of a segment, until it returns false. Returns whether it never
    // did. Points outside the image belong to the cells at its border.
    template <class Body>
    bool each_cell(Vec2 a, Vec2 b, double margin, Body body) const {
        const auto [left, right] = std::minmax(a.x, b.x);
        const int i0 = index(left - margin, columns_), i1 = index(right + margin, columns_);
        const double slope = right > left ? (b.y - a.y) / (b.x - a.x) : 0;
        for (int i = i0; i <= i1; ++i) {
            double y0 = a.y, y1 = b.y;
            if (i0 < i1) {
                const auto at = [&](double x) { return a.y + slope * (std::clamp(x, left, right) - a.x); };
                y0 = i == i0 ? at(left) : at(i * cell_ - margin),
                y1 = i == i1 ? at(right) : at((i + 1) * cell_ + margin);
            }
            const int j0 = index(std::min(y0, y1) - margin, rows_), j1 = index(std::max(y0, y1) + margin, rows_);
            for (int j = j0; j <= j1; ++j)
                if (!body(size_t(j) * columns_ + i)) return false;
        }
        return true;
    }
    int index(double x, int count) const { return int(std::clamp(x * per_cell_, 0.0, double(count - 1))); }

    // If a cell of about two pixels has more segments, some are assumed to cross.
    static constexpr uint32_t most_in_a_cell = 32;
    // Larger boxes are not searched.
    static constexpr int64_t most_cells = 64;

    double cell_, per_cell_;  // px, and its reciprocal
    int columns_, rows_;
    std::vector<uint32_t> begin_;  // first index of each cell in entries_
    Array<Segment> segments_{0};
    Array<uint32_t> entries_{0};
};

}  // namespace edgegrad
