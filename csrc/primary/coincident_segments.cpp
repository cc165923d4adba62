#include "primary/coincident_segments.h"

#include <bit>
#include <limits>
#include <new>

namespace edgegrad {

namespace {

// Occupancy stores for each of many buckets whether it got one or several segments. Two buckets may share a place.
class Occupancy {
   public:
    explicit Occupancy(int64_t segments) : words_(std::bit_ceil(2 * uint64_t(segments))), mask_(words_.size() - 1) {}

    // Any thread may add, in any order.
    void add(uint64_t key) {
        std::atomic<uint64_t>& w = word(key);
        const uint64_t one = bit(key), there = w.fetch_or(one, std::memory_order_relaxed);
        if (there & one && !(there & one << 1)) w.fetch_or(one << 1, std::memory_order_relaxed);
    }
    bool any(uint64_t key) const { return word(key).load(std::memory_order_relaxed) & bit(key); }
    bool several(uint64_t key) const { return word(key).load(std::memory_order_relaxed) & bit(key) << 1; }

   private:
    static uint64_t bit(uint64_t key) { return uint64_t(1) << (key >> 59 << 1); }
    std::atomic<uint64_t>& word(uint64_t key) { return words_[key & mask_]; }
    const std::atomic<uint64_t>& word(uint64_t key) const { return words_[key & mask_]; }

    std::vector<std::atomic<uint64_t>> words_;  // 32 pairs of bits each
    uint64_t mask_;
};

// Calls body(k, first, last) for parts of n segments. Parts are small, so that all threads get some.
constexpr int64_t segments_of_part = 256;
template <class Body>
void each_part(int64_t n, ThreadTeam& team, Body body) {
    team.parallel_for((n + segments_of_part - 1) / segments_of_part,
                      [&](int64_t k) { body(k, k * segments_of_part, std::min(n, (k + 1) * segments_of_part)); });
}

// Returns how s meets o, over the part of s that lies next to o.
CoincidentCurves::Overlap overlap_within(const ImageSegment& s, const ImageSegment& o) {
    const Vec2 along = s.b - s.a, other = o.b - o.a;
    const double squared = along.x * along.x + along.y * along.y;
    const auto parameter = [&](Vec2 x) { return ((x.x - s.a.x) * along.x + (x.y - s.a.y) * along.y) / squared; };
    const double t0 = parameter(o.a), t1 = parameter(o.b);
    // Segments that merely touch end to end do not meet. Neglecting a millionth of the length loses nothing.
    const double first = std::max(0.0, std::min(t0, t1)), last = std::min(1.0, std::max(t0, t1));
    using Overlap = CoincidentCurves::Overlap;
    if (!(last - first > 1e-6)) return Overlap::none;
    const double reach = std::max(s.reach, o.reach) * length(other);
    const auto aside = [&](double t) { return wedge(other, s.a + t * along - o.a); };  // px times the length of o
    const double d0 = aside(first), d1 = aside(last);
    const bool near0 = std::fabs(d0) <= reach, near1 = std::fabs(d1) <= reach;
    if (near0 && near1) return Overlap::along;
    return near0 || near1 || (d0 > 0) != (d1 > 0) ? Overlap::across : Overlap::none;
}

}  // namespace

CoincidentCurves::Overlap CoincidentCurves::overlap(const ImageSegment& s, const ImageSegment& o) {
    return std::max(overlap_within(s, o), overlap_within(o, s));
}

CoincidentCurves::CoincidentCurves(std::vector<std::vector<ImageSegment>> parts, const Systematic& samples,
                                   ThreadTeam& team) {
    const int64_t n_parts = int64_t(parts.size());
    std::vector<double> length_of(parts.size()), reach_of(parts.size());
    team.parallel_for(n_parts, [&](int64_t k) {
        double length = 0, reach = 0;
        for (const ImageSegment& s : parts[k]) length += edgegrad::length(s.b - s.a), reach = std::max(reach, s.reach);
        length_of[k] = length, reach_of[k] = reach;
    });
    int64_t n = 0;
    double total = 0;
    for (int64_t k = 0; k < n_parts; ++k)
        n += int64_t(parts[k].size()), total += length_of[k], margin_ = std::max(margin_, reach_of[k]);
    if (n == 0) return;
    // Cells are some segments wide, so that few segments share a cell of a fine mesh and many one of a coarse mesh. At
    // least 1e-6 px keeps the cells countable. At most 16 px lets distances in a cell separate lines, unless many long
    // segments would pass too many cells.
    const double cell = std::min(std::max({4 * total / double(n), 8 * margin_, 1e-6}), 16.0);
    lines_ = LineBuckets(std::max(cell, total / (2.0 * double(n) + 0x1p16)), margin_);
    keep_those_not_alone(parts, samples, team);

    std::vector<int64_t> first(parts.size() + 1, 0);
    for (size_t k = 0; k < parts.size(); ++k) first[k + 1] = first[k] + int64_t(parts[k].size());
    segments_ = Array<ImageSegment>(first.back());
    team.parallel_for(int64_t(parts.size()), [&](int64_t k) {
        std::copy(parts[k].begin(), parts[k].end(), segments_.begin() + first[k]);
        parts[k] = {};
    });
    if (segments_.empty()) return;
    fill(team);
    find_coincident(samples, team);
}

// In most scenes nearly all segments are alone on their lines.
void CoincidentCurves::keep_those_not_alone(std::vector<std::vector<ImageSegment>>& parts, const Systematic& samples,
                                            ThreadTeam& team) const {
    const int64_t n = int64_t(parts.size());
    std::atomic<int64_t> sampled = 0;
    team.parallel_for(n, [&](int64_t k) {
        sampled += std::count_if(parts[k].begin(), parts[k].end(),
                                 [&](const ImageSegment& s) { return samples.may_draw(s.curve); });
    });
    // All buckets around a sampled line are marked. Other lines then test only their own bucket.
    Occupancy around_sampled(4 * sampled), of_sampled(sampled), of_others(sampled);
    team.parallel_for(n, [&](int64_t k) {
        for (const ImageSegment& s : parts[k])
            if (samples.may_draw(s.curve))
                lines_.each_cell(s, [&](const LineBuckets::Line& l) {
                    uint64_t keys[4];
                    LineBuckets::keys_around(l, keys);
                    for (const uint64_t key : keys) around_sampled.add(key);
                    of_sampled.add(LineBuckets::key(l));
                });
    });
    team.parallel_for(n, [&](int64_t k) {
        std::erase_if(parts[k], [&](const ImageSegment& s) {
            if (samples.may_draw(s.curve)) return false;
            bool adjacent = false;
            lines_.each_cell(s, [&](const LineBuckets::Line& l) {
                const uint64_t key = LineBuckets::key(l);
                if (!around_sampled.any(key)) return;
                adjacent = true;
                of_others.add(key);
            });
            return !adjacent;
        });
    });
    team.parallel_for(n, [&](int64_t k) {
        std::erase_if(parts[k], [&](const ImageSegment& s) {
            if (!samples.may_draw(s.curve)) return false;
            bool alone = true;
            lines_.each_cell(s, [&](const LineBuckets::Line& l) {
                if (!alone) return;
                const uint64_t own = LineBuckets::key(l);
                uint64_t keys[4];
                LineBuckets::keys_around(l, keys);
                for (const uint64_t key : keys)
                    alone &= !of_others.any(key) && !(key == own ? of_sampled.several(key) : of_sampled.any(key));
            });
            return alone;
        });
    });
}

void CoincidentCurves::fill(ThreadTeam& team) {
    const int64_t n = segments_.size(), buckets = int64_t(std::bit_ceil(2 * uint64_t(n)));
    mask_ = uint64_t(buckets - 1);
    std::vector<std::atomic<uint32_t>> end(buckets);
    const auto each_entry = [&](auto entry) {
        each_part(n, team, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t i = first; i < last; ++i)
                lines_.each_cell(segments_[i], [&](const LineBuckets::Line& l) { entry(i, l); });
        });
    };
    each_entry([&](int64_t, const LineBuckets::Line& l) {
        end[LineBuckets::key(l) & mask_].fetch_add(1, std::memory_order_relaxed);
    });
    begin_.resize(buckets + 1);
    uint64_t sum = 0;
    for (int64_t k = 0; k < buckets; ++k) {
        begin_[k] = uint32_t(sum);
        sum += end[k].exchange(uint32_t(sum), std::memory_order_relaxed);
    }
    if (sum > std::numeric_limits<uint32_t>::max()) throw std::bad_alloc();  // 64 GB
    begin_[buckets] = uint32_t(sum);
    entries_ = Array<BucketEntry>(int64_t(sum));
    each_entry([&](int64_t i, const LineBuckets::Line& l) {
        const ImageSegment& s = segments_[i];
        const bool x = LineBuckets::runs_along_x(l);
        const double a = x ? s.a.x : s.a.y, b = x ? s.b.x : s.b.y;
        constexpr float infinity = std::numeric_limits<float>::infinity();
        entries_[end[LineBuckets::key(l) & mask_].fetch_add(1, std::memory_order_relaxed)] = {
            .low = std::nextafter(float(std::min(a, b) - margin_), -infinity),
            .high = std::nextafter(float(std::max(a, b) + margin_), infinity),
            .depth = float(s.depth),
            .segment = uint32_t(i)};
    });
    // The threads filled the buckets in any order, so sort them.
    team.parallel_for_blocks(buckets, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t k = first; k < last; ++k)
            std::sort(entries_.begin() + begin_[k], entries_.begin() + begin_[k + 1],
                      [](const BucketEntry& e, const BucketEntry& o) {
                          return e.depth != o.depth ? e.depth < o.depth : e.segment < o.segment;
                      });
    });
}

// Buckets also hold segments that follow end to end along a line. In a bucket with many, all are kept untested.
void CoincidentCurves::find_coincident(const Systematic& samples, ThreadTeam& team) {
    constexpr uint32_t most_tested = 64;
    const auto any_adjacent = [&](const ImageSegment& s, const LineBuckets::Line& l) {
        uint64_t keys[4];
        LineBuckets::keys_around(l, keys);
        const bool x = LineBuckets::runs_along_x(l);
        const float low = float(std::min(x ? s.a.x : s.a.y, x ? s.b.x : s.b.y)),
                    high = float(std::max(x ? s.a.x : s.a.y, x ? s.b.x : s.b.y));
        for (const uint64_t key : keys) {
            const uint32_t first = begin_[key & mask_], last = begin_[(key & mask_) + 1];
            if (last - first > most_tested) return true;
            for (uint32_t i = first; i < last; ++i) {
                const BucketEntry& e = entries_[i];
                const ImageSegment& o = segments_[e.segment];
                if (e.low <= high && low <= e.high && &o != &s && overlap(s, o) != Overlap::none) return true;
            }
        }
        return false;
    };
    std::vector<std::vector<CoincidentSegment>> parts((segments_.size() + segments_of_part - 1) / segments_of_part);
    each_part(segments_.size(), team, [&](int64_t k, int64_t first, int64_t last) {
        std::vector<CoincidentSegment> part;
        for (int64_t i = first; i < last; ++i) {
            if (!samples.may_draw(segments_[i].curve)) continue;
            bool found = false;
            lines_.each_cell(segments_[i],
                             [&](const LineBuckets::Line& l) { found = found || any_adjacent(segments_[i], l); });
            if (found) part.push_back({segments_[i].edge, uint32_t(i)});
        }
        parts[k] = std::move(part);
    });
    for (const auto& part : parts) coincident_.insert(coincident_.end(), part.begin(), part.end());
    std::sort(coincident_.begin(), coincident_.end(),
              [](const CoincidentSegment& a, const CoincidentSegment& b) { return a.edge < b.edge; });
}

const ImageSegment* CoincidentCurves::find(int64_t edge) const {
    const auto at = std::lower_bound(coincident_.begin(), coincident_.end(), edge,
                                     [](const CoincidentSegment& c, int64_t edge) { return c.edge < edge; });
    return at != coincident_.end() && at->edge == edge ? &segments_[at->segment] : nullptr;
}

CoincidentCurves::Overlap CoincidentCurves::at_point(const ImageSegment& other, const ImageSegment& own, Vec2 x) {
    const Vec2 along = other.b - other.a, from = x - other.a;
    const double far = length(along), reach = std::max(own.reach, other.reach);
    const double t = from.x * along.x + from.y * along.y;
    if (!(t >= -reach * far && t <= (far + reach) * far)) return Overlap::none;
    const double aside = std::fabs(wedge(along, from));
    if (!(aside <= 2 * reach * far)) return Overlap::none;  // This test spares most of what follows.
    const Overlap found = overlap(own, other);
    return found == Overlap::across && !(aside <= reach * far) ? Overlap::none : found;
}

}  // namespace edgegrad
