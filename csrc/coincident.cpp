#include "coincident.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <utility>

#include "sampler.h"

namespace edgegrad {

namespace {

// Whether two segments run side by side within their reach.
bool side_by_side(const ImageSegment& s, const ImageSegment& o) {
    const Vec2 along = s.b - s.a;
    const double squared = along.x * along.x + along.y * along.y, reach = std::max(s.reach, o.reach);
    const auto parameter = [&](Vec2 x) { return ((x.x - s.a.x) * along.x + (x.y - s.a.y) * along.y) / squared; };
    const double t0 = parameter(o.a), t1 = parameter(o.b);
    // Segments that merely touch end to end do not; a millionth of the length is no loss.
    const double first = std::max(0.0, std::min(t0, t1)), last = std::min(1.0, std::max(t0, t1));
    if (!(last - first > 1e-6)) return false;
    const auto distance = [&](double t) {  // of the point t of s to the line of o
        const Vec2 x = s.a + t * along, other = o.b - o.a;
        return std::fabs(wedge(other, x - o.a)) / length(other);
    };
    return distance(first) <= reach && distance(last) <= reach;
}

// Segments by the lines they lie on: buckets of direction, distance to the middle of a cell of the image, and cell.
// What runs side by side shares a cell, and there lies within half a bucket. Cells are some segments wide, so that few
// share one where a mesh is fine and many where it is coarse.
class LineBuckets {
   public:
    explicit LineBuckets(const std::vector<ImageSegment>& segments)
        : head_(std::bit_ceil(std::max<size_t>(64, 4 * segments.size())), -1), mask_(head_.size() - 1) {
        double total = 0, reach = 0;
        for (const ImageSegment& s : segments) total += length(s.b - s.a), reach = std::max(reach, s.reach);
        const double mean = total / double(std::max<size_t>(1, segments.size()));
        cell_ = std::min(std::max({4 * mean, 8 * reach, 1e-6}), 16.0);  // a millionth: so that cells can be counted
    }

    // Calls found(j) for every segment j added before that may run side by side with s, then adds s as number i.
    template <class Found>
    void add(int64_t i, const ImageSegment& s, Found found) {
        Vec2 along = s.b - s.a;
        if (along.y < 0 || (along.y == 0 && along.x < 0)) along = -1 * along;
        const double angle = std::atan2(along.y, along.x);
        const int parts = 1 + int(std::min(length(along) / cell_, 0x1p20));
        int64_t last_i0 = INT64_MAX, last_j0 = 0, last_i1 = 0, last_j1 = 0;
        for (int k = 0; k < parts; ++k) {
            const Vec2 p = s.a + (double(k) / parts) * (s.b - s.a), q = s.a + (double(k + 1) / parts) * (s.b - s.a);
            const int64_t i0 = index(std::min(p.x, q.x)), i1 = index(std::max(p.x, q.x));
            const int64_t j0 = index(std::min(p.y, q.y)), j1 = index(std::max(p.y, q.y));
            for (int64_t y = j0; y <= j1; ++y)
                for (int64_t x = i0; x <= i1; ++x) {
                    if (x >= last_i0 && x <= last_i1 && y >= last_j0 && y <= last_j1) continue;
                    const Vec2 middle{(double(x) + 0.5) * cell_, (double(y) + 0.5) * cell_};
                    const double distance = wedge(along, s.a - middle) / length(along);
                    add(i, x, y, angle, distance, found);
                    // Directions wrap around, and the side of the line with them.
                    if (angle < angle_step) add(i, x, y, angle + M_PI, -distance, found);
                }
            last_i0 = i0, last_i1 = i1, last_j0 = j0, last_j1 = j1;
        }
    }

   private:
    static constexpr double angle_step = 0.005, distance_step = 0.05;  // radians, px
    struct Entry {
        uint64_t key;
        int64_t segment;
        int64_t next;
    };

    int64_t index(double x) const { return int64_t(std::floor(x / cell_)); }

    template <class Found>
    void add(int64_t i, int64_t x, int64_t y, double angle, double distance, Found found) {
        const double u = angle / angle_step, v = distance / distance_step;
        const auto key = [&](double u, double v) {
            return hash(uint64_t(x) << 32 ^ uint64_t(y), uint64_t(int64_t(std::floor(u))),
                        uint64_t(int64_t(std::floor(v))));
        };
        for (const double du : {-0.5, 0.5})
            for (const double dv : {-0.5, 0.5}) {
                const uint64_t wanted = key(u + du, v + dv);
                for (int64_t e = head_[wanted & mask_]; e >= 0; e = entries_[e].next)
                    if (entries_[e].key == wanted && entries_[e].segment != i) found(entries_[e].segment);
            }
        const uint64_t own = key(u, v);
        entries_.push_back({own, i, head_[own & mask_]});
        head_[own & mask_] = int64_t(entries_.size()) - 1;
    }

    double cell_ = 16;  // px
    std::vector<int64_t> head_;
    size_t mask_;
    std::vector<Entry> entries_;
};

}  // namespace

CoincidentCurves::CoincidentCurves(const std::vector<ImageSegment>& segments, Team& team) {
    std::vector<std::pair<int64_t, int64_t>> pairs;
    LineBuckets buckets(segments);
    for (int64_t i = 0; i < int64_t(segments.size()); ++i) {
        if (i % 4096 == 0) team.check();
        buckets.add(i, segments[i], [&](int64_t j) {
            if (side_by_side(segments[i], segments[j]) || side_by_side(segments[j], segments[i]))
                pairs.insert(pairs.end(), {{segments[i].edge, segments[j].edge}, {segments[j].edge, segments[i].edge}});
        });
    }
    std::sort(pairs.begin(), pairs.end());
    pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
    for (const auto& [edge, other] : pairs) {
        if (edge_.empty() || edge_.back() != edge) edge_.push_back(edge), offset_.push_back(int64_t(other_.size()));
        other_.push_back(other);
    }
    offset_.push_back(int64_t(other_.size()));
}

std::span<const int64_t> CoincidentCurves::of(int64_t edge) const {
    const auto at = std::lower_bound(edge_.begin(), edge_.end(), edge);
    if (at == edge_.end() || *at != edge) return {};
    const int64_t i = at - edge_.begin();
    return {other_.data() + offset_[i], other_.data() + offset_[i + 1]};
}

}  // namespace edgegrad
