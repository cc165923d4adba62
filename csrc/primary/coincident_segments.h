// Curves that lie on one another in the image: the front and the back edge of a box that is seen straight on, meshes
// in the same place, a long edge against two short ones; or nearly so, as what leaves one vertex at the limb of a
// sphere.
//
// Pairs of them are not kept, for N curves on one line have N² / 2. Curves are sorted into buckets by direction,
// distance and cell of the image, and who lies on a curve at one of its points is looked up there, from near to far.
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

// A curve in the image.
struct ImageSegment {
    int32_t edge, curve;  // the latter as samples count it
    Vec2 a, b;
    double reach;     // px by which the rays of Embree may miss it: its floats are no finer
    double rounding;  // px, of its doubles
    double depth;     // of its nearer end
};

// Lines through the cells of the image: buckets of direction and of distance to the middle of a cell. Of what runs side
// by side in a cell, each lies within half a bucket of the other.
class LineBuckets {
   public:
    // A line in a cell, in buckets; its direction is found modulo `directions`, where the sign of the distance turns.
    struct Line {
        uint64_t cell;
        double direction, distance;
    };

    explicit LineBuckets(double cell = 1, double margin = 0) : cell_(cell), per_cell_(1 / cell), margin_(margin) {}

    // Calls found(line) for every cell that the segment passes at less than the margin.
    template <class Found>
    void each_cell(const ImageSegment& s, Found found) const {
        const Direction direction(s.b - s.a);
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

    // The line of a segment in the cell of its point x.
    Line line_at(const ImageSegment& s, Vec2 x) const {
        return line(Direction(s.b - s.a), s.a, index(x.x), index(x.y));
    }

    // Random bits that stand for a line's own bucket.
    static uint64_t key(const Line& l) { return key(l, floor(l.direction), l.distance); }

    // Those of the four buckets in which lines lie side by side with it, its own among them.
    static void keys_around(const Line& l, uint64_t (&keys)[4]) {
        for (int k = 0; k < 4; ++k)
            keys[k] = key(l, floor(l.direction + (k & 1 ? 0.5 : -0.5)), l.distance + (k & 2 ? 0.5 : -0.5));
    }

    // Whether lines of that direction run along x rather than y.
    static bool runs_along_x(const Line& l) { return std::fabs(l.direction - directions / 2.0) > directions / 4.0; }

   private:
    // In place of an angle: 1 − x / (|x| + y) of a direction with y ≥ 0, which is from 0 to 2 and grows by ½ to 1 a
    // radian.
    static constexpr int64_t directions = 400;
    static constexpr double distance_step = 0.05;  // px
    struct Direction {
        Vec2 along;
        double length, direction, per_distance;
        explicit Direction(Vec2 d) : along(d.y < 0 || (d.y == 0 && d.x < 0) ? -1 * d : d), length(edgegrad::length(d)) {
            direction = (1 - along.x / (std::fabs(along.x) + along.y)) * (directions / 2.0);
            per_distance = 1 / (length * distance_step);
        }
    };

    static int64_t floor(double x) {
        const int64_t i = int64_t(x);
        return i - (double(i) > x);
    }
    int64_t index(double x) const { return floor(x * per_cell_); }

    Line line(const Direction& d, Vec2 a, int64_t i, int64_t j) const {
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
    // Of the segments in all parts. Only what lies near those that have samples is kept.
    CoincidentCurves(std::vector<std::vector<ImageSegment>> parts, const Systematic& samples, ThreadTeam& team);

    // Of each curve, at most: its segment in a list that doubles as it grows, and again where others lie on its line;
    // two tables; its entry in each of up to 7 cells; its companion, twice. Most pass one or two cells, and are alone.
    static constexpr int64_t bytes_per_curve() {
        return sizeof(ImageSegment) + 2 * 16 + 7 * sizeof(Entry) + 2 * sizeof(CoincidentSegment);
    }

    // The segment of an edge that has samples; null if no other lies on it anywhere.
    const ImageSegment* find(int64_t edge) const;

    // How two segments meet that come closer in the image than rays err: side by side wherever both are, or at an angle
    // so small that more than a point of one is so near to the other, as where they share an end.
    enum class Meeting { none, across, along };

    // Calls found(other, meeting) for the segments that pass the point x of one of find() so closely, until it returns
    // false.
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
                const Entry& e = entries_[i];
                if (!(e.low <= place && place <= e.high)) continue;
                const ImageSegment& other = segments_[e.segment];
                if (&other == &own) continue;
                const Meeting meeting = at_point(other, own, x);
                if (meeting != Meeting::none && !found(other, meeting)) return;
            }
        }
    }

   private:
    // A segment in a bucket, and from where to where it goes along x or y, whichever is more.
    struct Entry {
        float low, high, depth;
        uint32_t segment;
    };

    void keep_those_not_alone(std::vector<std::vector<ImageSegment>>& parts, const Systematic& samples,
                              ThreadTeam& team) const;
    void fill(ThreadTeam& team);
    void find_coincident(const Systematic& samples, ThreadTeam& team);
    static Meeting meeting(const ImageSegment& s, const ImageSegment& o);
    static Meeting at_point(const ImageSegment& other, const ImageSegment& own, Vec2 x);

    LineBuckets lines_;
    // A segment that others lie on.
    struct CoincidentSegment {
        int64_t edge;
        uint32_t segment;
    };

    Array<ImageSegment> segments_{0};
    std::vector<CoincidentSegment> coincident_;  // by ascending edges
    uint64_t mask_ = 0;
    std::vector<uint32_t> begin_;  // of each bucket, in entries_
    Array<Entry> entries_{0};
    double margin_ = 0;  // px
};

}  // namespace edgegrad
