// This file finds curves that coincide, or nearly coincide, in the image. Examples are the front and back edge of a box
// seen straight on, meshes in the same place, or a long edge against two short ones. At the limb of a sphere, edges of
// one vertex nearly coincide.
//
// Pairs are not stored, because N curves on one line have N² / 2. Curves are sorted into buckets by direction, distance
// and cell of the image. A query at a point of a curve walks the bucket from near to far.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"
#include "core/sampler.h"
#include "core/systematic.h"

namespace edgegrad {

// An ImageSegment is a curve in the image.
struct ImageSegment {
    int32_t edge, curve;  // edge of the mesh; number of the curve for samples
    Vec2 a, b;
    double reach;     // px by which Embree's single-precision rays may miss it
    double rounding;  // px, rounding of its doubles
    double depth;     // depth of its nearer end
};

// LineBuckets hashes lines through the cells of the image by direction and by distance to the middle of a cell. Two
// lines side by side in a cell lie within half a bucket of each other.
class LineBuckets {
   public:
    // A Line in a cell is measured in buckets. Directions are modulo `directions`, where distances change sign.
    struct Line {
        uint64_t cell;
        double direction, distance;
    };

    explicit LineBuckets(double cell = 1, double margin = 0) : cell_(cell), per_cell_(1 / cell), margin_(margin) {}

    // Calls found(line) for every cell that the segment passes at less than the margin.
    template <class Found>
    void each_cell(const ImageSegment& s, Found found) const {
        const LineDirection direction(s.b - s.a);
        const int parts = 1 + int(std::min(direction.length * per_cell_, 0x1p20));
        int64_t last_i0 = INT64_MAX, last_j0 = 0, last_i1 = 0, last_j1 = 0;
        for (int k = 0; k < parts; ++k) {
            const Vec2 p = s.a + (double(k) / parts) * (s.b - s.a), q = s.a + (double(k + 1) / parts) * (s.b - s.a);
            const int64_t i0 = index(std::min(p.x, q.x) - margin_), i1 = index(std::max(p.x, q.x) + margin_);
            const int64_t j0 = index(std::min(p.y, q.y) - margin_), j1 = index(std::max(p.y, q.y) + margin_);
            for (int64_t j = j0; j <= j1; ++j)
                for (int64_t i = i0; i <= i1; ++i) {
                    if (i >= last_i0 && i <= last_i1 && j >= last_j0 && j <= last_j1) continue;
                    found(line(direction, s.a, i, j));
                }
            last_i0 = i0, last_i1 = i1, last_j0 = j0, last_j1 = j1;
        }
    }

    // Returns the line of a segment in the cell of its point x.
    Line line_at(const ImageSegment& s, Vec2 x) const {
        return line(LineDirection(s.b - s.a), s.a, index(x.x), index(x.y));
    }

    // Returns random bits that stand for a line's own bucket.
    static uint64_t key(const Line& l) { return key(l, floor(l.direction), l.distance); }

    // Writes the keys of the four buckets that hold the lines next to it, its own bucket included.
    static void keys_around(const Line& l, uint64_t (&keys)[4]) {
        for (int k = 0; k < 4; ++k)
            keys[k] = key(l, floor(l.direction + (k & 1 ? 0.5 : -0.5)), l.distance + (k & 2 ? 0.5 : -0.5));
    }

    // Returns whether lines of that direction run along x rather than y.
    static bool runs_along_x(const Line& l) { return std::fabs(l.direction - directions / 2.0) > directions / 4.0; }

   private:
    // Directions are measured by 1 − x / (|x| + y), y ≥ 0, which grows from 0 to 2, by ½ to 1 per radian.
    static constexpr int64_t directions = 400;
    static constexpr double distance_step = 0.05;  // px
    struct LineDirection {
        Vec2 along;
        double length, direction, per_distance;
        explicit LineDirection(Vec2 d)
            : along(d.y < 0 || (d.y == 0 && d.x < 0) ? -1 * d : d), length(edgegrad::length(d)) {
            direction = (1 - along.x / (std::fabs(along.x) + along.y)) * (directions / 2.0);
            per_distance = 1 / (length * distance_step);
        }
    };

    static int64_t floor(double x) {
        const int64_t i = int64_t(x);
        return i - (double(i) > x);
    }
    int64_t index(double x) const { return floor(x * per_cell_); }

    Line line(const LineDirection& d, Vec2 a, int64_t i, int64_t j) const {
        const Vec2 middle{(double(i) + 0.5) * cell_, (double(j) + 0.5) * cell_};
        return {uint64_t(i) << 32 ^ uint64_t(j), d.direction, wedge(d.along, a - middle) * d.per_distance};
    }

    static uint64_t key(const Line& l, int64_t direction, double distance) {
        if (direction < 0) direction += directions, distance = -distance;
        if (direction >= directions) direction -= directions, distance = -distance;
        return mix(l.cell * 0x9e3779b97f4a7c15ull + uint64_t(direction) * 0xc13fa9a902a6328full +
                   uint64_t(floor(distance)) * 0x91e10da5c79e7b1dull);
    }

    double cell_, per_cell_, margin_;  // px
};

class CoincidentCurves {
   public:
    // Takes the segments of all parts, and keeps those near segments that have samples.
    CoincidentCurves(std::vector<std::vector<ImageSegment>> parts, const Systematic& samples, ThreadTeam& team);

    // Returns an upper bound of the memory per curve. It counts the segment in a list that doubles, and again where
    // others lie on its line. It adds two tables, up to 7 cell entries, and its CoincidentSegment, twice. Most curves
    // pass one or two cells, and are alone.
    static constexpr int64_t bytes_per_curve() {
        return sizeof(ImageSegment) + 2 * 16 + 7 * sizeof(BucketEntry) + 2 * sizeof(CoincidentSegment);
    }

    // Returns the segment of an edge that has samples; null if no other segment lies on it anywhere.
    const ImageSegment* find(int64_t edge) const;

    // Overlap tells how two segments lie that come closer in the image than the error of rays. `along` ones are so
    // close wherever both exist. `across` ones meet at a small angle, where more than a point of one is close.
    enum class Overlap { none, across, along };

    // Calls found(other, overlap) for segments that pass so close to the point x of `own`, until it returns false.
    template <class Found>
    void at(const ImageSegment& own, Vec2 x, Found found) const {
        const LineBuckets::Line line = lines_.line_at(own, x);
        const double place = LineBuckets::runs_along_x(line) ? x.x : x.y;
        uint64_t bucket[4];
        LineBuckets::keys_around(line, bucket);
        for (int k = 0; k < 4; ++k) {
            bucket[k] &= mask_;
            if (std::find(bucket, bucket + k, bucket[k]) != bucket + k) continue;
            for (uint32_t i = begin_[bucket[k]]; i < begin_[bucket[k] + 1]; ++i) {
                const BucketEntry& e = entries_[i];
                if (!(e.low <= place && place <= e.high)) continue;
                const ImageSegment& other = segments_[e.segment];
                if (&other == &own) continue;
                const Overlap overlap = at_point(other, own, x);
                if (overlap != Overlap::none && !found(other, overlap)) return;
            }
        }
    }

   private:
    // A BucketEntry is a segment in a bucket, with its interval along the longer of x and y.
    struct BucketEntry {
        float low, high, depth;
        uint32_t segment;
    };

    void keep_those_not_alone(std::vector<std::vector<ImageSegment>>& parts, const Systematic& samples,
                              ThreadTeam& team) const;
    void fill(ThreadTeam& team);
    void find_coincident(const Systematic& samples, ThreadTeam& team);
    static Overlap overlap(const ImageSegment& s, const ImageSegment& o);
    static Overlap at_point(const ImageSegment& other, const ImageSegment& own, Vec2 x);

    LineBuckets lines_;
    // A CoincidentSegment is a segment that others lie on.
    struct CoincidentSegment {
        int64_t edge;
        uint32_t segment;
    };

    Array<ImageSegment> segments_{0};
    std::vector<CoincidentSegment> coincident_;  // in ascending order of edges
    uint64_t mask_ = 0;
    std::vector<uint32_t> begin_;  // first index of each bucket in entries_
    Array<BucketEntry> entries_{0};
    double margin_ = 0;  // px
};

}  // namespace edgegrad
