// This file places samples on shadow boundaries. Pieces of edges before parts of a light (shadow_edges.h) lie end to
// end by an estimate of their shadows that needs no ray. Pilots set the density along them.
#pragma once

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "core/sampler.h"
#include "core/systematic.h"
#include "secondary/light_rays.h"
#include "secondary/shadow_edges.h"

namespace edgegrad {

constexpr double most_of_edge = 64;    // maximum number of pieces of an edge
constexpr int pilots_of_interval = 4;  // number of pilots per interval
constexpr int64_t intervals_of_block = 64;
constexpr int64_t intervals_around = 16;   // number of intervals on either side whose pilots are shared
constexpr int64_t antithetic_samples = 2;  // samples per place before a light with an extent
constexpr double own_share = 0.3;          // fraction of the mean square that comes from the interval itself
constexpr double uniform_share = 0.1;      // fraction of the density that is independent of pilots
constexpr int64_t pair_tests = 1 << 22;    // number of tested pairs of edges and light parts
constexpr int64_t fewest_intervals = 1 << 10, most_intervals = 1 << 15, samples_of_interval = 16;

// Cuts edges with much of the measure, because samples run along the light's wedges, at drawn places of the edge.
inline std::vector<ShadowPiece> cut(const std::vector<ShadowPiece>& pieces, double intervals) {
    double total = 0;
    for (const ShadowPiece& p : pieces) total += p.measure;
    std::vector<ShadowPiece> out;
    out.reserve(pieces.size());
    for (const ShadowPiece& p : pieces) {
        const int n = int(std::clamp(std::sqrt(p.measure / total * intervals), 1.0, most_of_edge));
        for (int k = 0; k < n; ++k)
            out.push_back({p.edge, p.part, float(k) / float(n), float(k + 1) / float(n), p.share, p.measure / n});
    }
    return out;
}

// ShadowPieces maps positions in [0, 1) to pieces laid end to end by their measure.
class ShadowPieces {
   public:
    ShadowPieces(std::vector<ShadowPiece> pieces, ThreadTeam& team)
        : pieces_(std::move(pieces)), measure_(int64_t(pieces_.size())), systematic_(fill(), team) {}

    bool empty() const { return !(systematic_.total() > 0); }

    struct PiecePoint {
        int64_t piece;
        double fraction;  // position within the piece
        double weight;    // reciprocal density of evenly drawn places
    };
    // Returns the piece at a position. `before` is the piece of an earlier position, or −1.
    int64_t piece(double position, int64_t before) const {
        const double p = std::min(position * systematic_.total(), std::nextafter(systematic_.total(), 0.0));
        return before < 0 ? systematic_.primitive(p) : systematic_.primitive(p, before);
    }
    PiecePoint at(double position, int64_t before) const {
        const int64_t k = piece(position, before);
        const double measure = systematic_.measure_of(k);
        return {k, std::clamp((position * systematic_.total() - systematic_.begin_of(k)) / measure, 0.0, 1.0),
                pieces_[k].share * double(pieces_[k].t1 - pieces_[k].t0) * systematic_.total() / measure};
    }
    // begin() and end() return the positions between which a piece lies.
    double begin(int64_t k) const { return systematic_.begin_of(k) / systematic_.total(); }
    double end(int64_t k) const { return begin(k) + systematic_.measure_of(k) / systematic_.total(); }
    const ShadowPiece& operator[](int64_t k) const { return pieces_[k]; }

   private:
    Array<double>& fill() {
        for (size_t k = 0; k < pieces_.size(); ++k) measure_[int64_t(k)] = pieces_[k].measure;
        return measure_;
    }
    std::vector<ShadowPiece> pieces_;
    Array<double> measure_;
    Systematic systematic_;
};

// ShadowPilot is what a pilot finds.
struct ShadowPilot {
    double swept_light;  // swept area · light
    double length = 0;   // px
};

// ShadowStatistics holds sums over the pilots of an interval.
struct ShadowStatistics {
    double squares = 0;  // of ShadowPilot::swept_light
    double length = 0;   // px

    void add(ShadowPilot pilot) {
        if (!std::isfinite(pilot.swept_light)) return;
        squares += pilot.swept_light * pilot.swept_light, length += pilot.length;
    }
};

// ShadowPositions draws n positions along the pieces from a density that is constant in equal intervals. They are
// equally spaced, except in a piece whose expected number is at least one. There they are spread evenly from end to
// end, each jittered in its stratum. Otherwise rounding their number per piece would cause most of the variance
// between vertices. The estimate is unbiased given any number of positions.
class ShadowPositions {
   public:
    // `density` has one number per interval and becomes its running sum. `whole` gives pieces whole numbers of
    // positions.
    ShadowPositions(const ShadowPieces& pieces, Array<double>& density, int64_t n, bool whole, uint64_t seed,
                    ThreadTeam& team)
        : pieces_(pieces), intervals_(density.size()), whole_(whole), seed_(seed), systematic_(density, team) {
        systematic_.draw(n, to_unit(seed));
        spacing_ = systematic_.total() / double(n);
    }

    struct DrawnPosition {
        double position;  // position along the pieces
        int64_t interval;
        double weight;  // reciprocal density
    };

    // Returns the i-th position; i must ascend between calls.
    DrawnPosition operator()(int64_t i) {
        const double even = systematic_.position(i);
        interval_ = interval_ < 0 ? systematic_.primitive(even) : systematic_.primitive(even, interval_);
        const double position = position_of(even, interval_);
        if (!whole_) return {position, interval_, weight_of(interval_)};
        piece_ = pieces_.piece(position, piece_);
        const double begin = pieces_.begin(piece_), end = pieces_.end(piece_);
        const double from = sum_before(begin), due = (sum_before(end) - from) / spacing_;
        const int64_t first = number_from(from), count = number_from(from + due * spacing_) - first;
        if (!(due >= 1) || i < first || i >= first + count) return {position, interval_, weight_of(interval_)};
        const double share = (double(i - first) + to_unit(hash(seed_, piece_))) / double(count);
        const double at = from + share * due * spacing_;
        const int64_t interval = systematic_.primitive(at, interval_at(begin));
        return {std::clamp(position_of(at, interval), begin, std::nextafter(end, 0.0)), interval,
                weight_of(interval) * due / double(count)};
    }

   private:
    int64_t interval_at(double position) const {
        return std::min(int64_t(position * double(intervals_)), intervals_ - 1);
    }
    // sum_before returns the density's sum up to a position. position_of is its inverse.
    double sum_before(double position) const {
        const int64_t k = interval_at(position);
        return systematic_.begin_of(k) + (position * double(intervals_) - double(k)) * systematic_.measure_of(k);
    }
    double position_of(double sum, int64_t k) const {
        const double fraction = (sum - systematic_.begin_of(k)) / systematic_.measure_of(k);
        return (double(k) + std::clamp(fraction, 0.0, 1.0)) / double(intervals_);
    }
    // Returns the number of the first position at or after a sum.
    int64_t number_from(double sum) const { return int64_t(std::ceil((sum - systematic_.position(0)) / spacing_)); }
    double weight_of(int64_t interval) const { return systematic_.weight(interval) / double(intervals_); }

    const ShadowPieces& pieces_;
    const int64_t intervals_;
    const bool whole_;
    const uint64_t seed_;
    Systematic systematic_;
    double spacing_;
    int64_t interval_ = -1, piece_ = -1;
};

// ShadowScene holds what chunks of samples share.
template <class T>
struct ShadowScene {
    const BackwardView<T>& view;
    const SceneView<T>& casters;
    const LightParts& light;
    const FacesBeforeLight<T>& faces;
    const std::vector<AlphaEdge>& alpha_edges;
    const ShadowPieces& pieces;
};

// ShadowChunk traces light rays past edges, and calls body(ShadowPoint, weight) for each shadow boundary behind.
template <class T, class Body>
class ShadowChunk {
   public:
    ShadowChunk(const ShadowScene<T>& scene, uint64_t seed, Body body)
        : scene_(scene),
          sequence_(seed),
          wedge_(scene.view, scene.casters, scene.faces, scene.alpha_edges),
          light_rays_(scene.view, scene.casters, scene.light, scene.alpha_edges),
          body_(std::move(body)) {}

    // Adds the i-th of ascending places, with `samples` samples. A second sample mirrors the first on the edge: the
    // split between the two ends would cause most of the noise where samples are few.
    void add(int64_t i, double position, int64_t interval, double weight, int64_t samples) {
        const auto place = scene_.pieces.at(position, piece_);
        const ShadowPiece& piece = scene_.pieces[place.piece];
        if (place.piece != piece_) casts_ = wedge_.set(piece), piece_ = place.piece;
        if (!casts_) return;
        const Vec2 other = sequence_(uint64_t(i));
        // The place runs along the edge before a point light, and along the wedge otherwise.
        const double t = scene_.light.extended ? other.x : place.fraction;
        for (int64_t k = 0; k < samples; ++k) {
            const auto from = wedge_->at(place.fraction, k ? 1 - other.y : other.y);
            light_rays_.add(piece, from, interval, piece.t0 + (k ? 1 - t : t) * double(piece.t1 - piece.t0),
                            weight * place.weight / double(samples));
            if (light_rays_.is_full()) cast();
        }
    }
    void cast() { light_rays_.cast(body_); }

   private:
    const ShadowScene<T> scene_;
    const ShiftedSequence sequence_;
    int64_t piece_ = -1;
    bool casts_ = false;  // whether that piece casts a shadow
    EdgeWedge<T> wedge_;
    LightRays<T> light_rays_;
    Body body_;
};

// Returns the density of samples in each interval. Neighbouring pilots may have found what an interval's own missed, so
// most of the mean square is theirs.
inline Array<double> density_of(const std::vector<ShadowStatistics>& of_interval) {
    const auto count = int64_t(of_interval.size());
    Array<double> measure(count);
    double known = 0;
    for (int64_t i = 0; i < count; ++i) {
        double around = 0;
        const int64_t low = std::max<int64_t>(i - intervals_around, 0),
                      high = std::min(i + intervals_around, count - 1);
        for (int64_t k = low; k <= high; ++k) around += of_interval[k].squares / double(high - low + 1);
        measure[i] = std::sqrt((own_share * of_interval[i].squares + (1 - own_share) * around) / pilots_of_interval),
        known += measure[i] / double(count);
    }
    for (int64_t i = 0; i < count; ++i) measure[i] += uniform_share * (known > 0 ? known : 1);
    return measure;
}

// ShadowSampler draws points of a light's shadow boundaries (estimator.h).
template <class T>
class ShadowSampler {
   public:
    struct Streams {
        Stream pilots, places, rays;
    };
    // `expected` is the approximate number of samples.
    ShadowSampler(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, Streams streams,
                  int64_t expected)
        : streams_(streams),
          intervals_(std::clamp(expected / samples_of_interval, fewest_intervals, most_intervals)),
          faces_(view.scene, light, view.team),
          alpha_edges_(
              AlphaEdgeFinder<T>(casters).find(seed_of(view.options.seed, Stream::shadow_alpha_edges), view.team)),
          pieces_(find(view, casters, light), view.team),
          scene_{view, casters, light, faces_, alpha_edges_, pieces_},
          of_interval_(intervals_) {}

    bool is_empty() const { return pieces_.empty(); }

    // Returns the length of the boundary that pilots found, px, averaged over the light.
    double length() const {
        double sum = 0;
        for (const ShadowStatistics& found : of_interval_)
            sum += found.length / double(pilots_of_interval * intervals_);
        return sum;
    }

    // Casts pilots in each interval.
    template <class Receiver>
    void cast_pilots(const Receiver& receiver) {
        const uint64_t seed = seed_of(scene_.view.options.seed, streams_.pilots);
        scene_.view.team.parallel_for((intervals_ + intervals_of_block - 1) / intervals_of_block, [&](int64_t block) {
            const int64_t first = block * intervals_of_block, last = std::min(first + intervals_of_block, intervals_);
            const auto trace = [&](auto body) {
                ShadowChunk chunk(scene_, mix(seed), body);
                for (int64_t i = first; i < last; ++i) {
                    const double shift = to_unit(hash(seed, i));
                    for (int k = 0; k < pilots_of_interval; ++k)
                        chunk.add(i * pilots_of_interval + k,
                                  (double(i) + (k + shift) / pilots_of_interval) / double(intervals_), i, 1, 1);
                }
                chunk.cast();
            };
            receiver.cast_pilots(
                trace, [&](const ShadowPoint& point, ShadowPilot pilot) { of_interval_[point.segment].add(pilot); });
        });
    }

    // Returns the number of places for n samples.
    int64_t lay_out(int64_t n) {
        const bool extended = scene_.light.extended;
        samples_of_place_ = extended ? antithetic_samples : 1;
        const int64_t places = (n + samples_of_place_ - 1) / samples_of_place_;
        density_ = density_of(of_interval_);
        places_.emplace(pieces_, density_, places, extended, seed_of(scene_.view.options.seed, streams_.places),
                        scene_.view.team);
        return places;
    }

    template <class Body>
    void trace(int64_t first, int64_t last, Body body) const {
        ShadowChunk chunk(scene_, seed_of(scene_.view.options.seed, streams_.rays), body);
        ShadowPositions place(*places_);
        for (int64_t i = first; i < last; ++i) {
            const auto [position, interval, weight] = place(i);
            chunk.add(i, position, interval, weight, samples_of_place_);
        }
        chunk.cast();
    }

   private:
    std::vector<ShadowPiece> find(const BackwardView<T>& view, const SceneView<T>& casters,
                                  const LightParts& light) const {
        std::vector<ShadowPiece> found =
            ShadowEdgeFinder<T>(view, casters, light, faces_, alpha_edges_).find(pair_tests);
        return light.extended ? cut(found, double(intervals_)) : found;
    }

    const Streams streams_;
    const int64_t intervals_;
    const FacesBeforeLight<T> faces_;
    const std::vector<AlphaEdge> alpha_edges_;
    const ShadowPieces pieces_;
    const ShadowScene<T> scene_;
    std::vector<ShadowStatistics> of_interval_;
    int64_t samples_of_place_ = 1;
    Array<double> density_{0};
    std::optional<ShadowPositions> places_;
};

}  // namespace edgegrad
