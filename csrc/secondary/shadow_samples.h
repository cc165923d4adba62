// Where samples on the borders of shadows lie: the pieces of edges before parts of a light (shadow_edges.h), end to end
// by what is known of their shadows without a ray, and the density along them that pilots say.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/sampler.h"
#include "core/systematic.h"
#include "secondary/light_rays.h"
#include "secondary/shadow_edges.h"

namespace edgegrad {

constexpr double most_of_edge = 64;  // pieces
constexpr int pilots = 4;            // places of an interval
constexpr int64_t intervals_of_block = 64;
constexpr int64_t neighbours = 16;       // of an interval, on either side
constexpr int64_t mirrored = 2;          // samples of a place before a light with an extent
constexpr double own_share = 0.3;        // of the mean square that is the interval's own
constexpr double floor_share = 0.1;      // of the density that pilots do not decide
constexpr int64_t pair_tests = 1 << 22;  // of edges before parts of the light
constexpr int64_t fewest_intervals = 1 << 10, most_intervals = 1 << 15, samples_of_interval = 16;
constexpr int64_t fewest_samples = 256, most_samples = 1 << 18;

// Samples run along the light's wedges, and where on the edge is drawn: so edges that make up much of the measure are
// cut.
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

// Pieces end to end: positions in [0, 1) along their measure.
class Pieces {
   public:
    Pieces(std::vector<ShadowPiece> pieces, ThreadTeam& team)
        : pieces_(std::move(pieces)), measure_(int64_t(pieces_.size())), systematic_(fill(), team) {}

    bool empty() const { return !(systematic_.total() > 0); }

    struct Place {
        int64_t piece;
        double fraction;  // of it
        double weight;    // that it has, were places drawn evenly: one over its density
    };
    // That at a position; `before`: the piece of one at a position before it, or −1.
    int64_t piece(double position, int64_t before) const {
        const double p = std::min(position * systematic_.total(), std::nextafter(systematic_.total(), 0.0));
        return before < 0 ? systematic_.primitive(p) : systematic_.primitive(p, before);
    }
    Place at(double position, int64_t before) const {
        const int64_t k = piece(position, before);
        const double measure = systematic_.measure_of(k);
        return {k, std::clamp((position * systematic_.total() - systematic_.begin_of(k)) / measure, 0.0, 1.0),
                pieces_[k].share * double(pieces_[k].t1 - pieces_[k].t0) * systematic_.total() / measure};
    }
    // Where a piece begins and ends.
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

// What pilots find of an interval: sums over them.
struct ShadowStatistics {
    double squares = 0;  // (swept area · light)²
    double length = 0;   // px
};

// Where the samples lie: n places in proportion to a density that is constant in equal intervals of the pieces'
// positions. They are equally spaced; but those of a piece that is due at least one are then spread evenly from end to
// end of it, each somewhere in its share. By how many places the piece has, more or less than it is due, vertices would
// otherwise differ most. For each number of places the mean over where they lie is right.
class Places {
   public:
    // density  one number for each interval; becomes its running sum
    // whole    whether pieces get whole numbers of places
    Places(const Pieces& pieces, Array<double>& density, int64_t n, bool whole, uint64_t seed, ThreadTeam& team)
        : pieces_(pieces), intervals_(density.size()), whole_(whole), seed_(seed), systematic_(density, team) {
        systematic_.draw(n, to_unit(seed));
        spacing_ = systematic_.total() / double(n);
    }

    struct Place {
        double position;  // along the pieces
        int64_t interval;
        double weight;  // one over its density
    };

    // The i-th; places are asked for in ascending order.
    Place operator()(int64_t i) {
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
    // The density's sum up to a position, and the position from where it is that.
    double sum_before(double position) const {
        const int64_t k = interval_at(position);
        return systematic_.begin_of(k) + (position * double(intervals_) - double(k)) * systematic_.measure_of(k);
    }
    double position_of(double sum, int64_t k) const {
        const double fraction = (sum - systematic_.begin_of(k)) / systematic_.measure_of(k);
        return (double(k) + std::clamp(fraction, 0.0, 1.0)) / double(intervals_);
    }
    // Of the first place that is no less than a sum.
    int64_t number_from(double sum) const { return int64_t(std::ceil((sum - systematic_.position(0)) / spacing_)); }
    double weight_of(int64_t interval) const { return systematic_.weight(interval) / double(intervals_); }

    const Pieces& pieces_;
    const int64_t intervals_;
    const bool whole_;
    const uint64_t seed_;
    Systematic systematic_;
    double spacing_;
    int64_t interval_ = -1, piece_ = -1;
};

// What chunks of samples share.
template <class T>
struct ShadowScene {
    const BackwardView<T>& view;
    const SceneView<T>& casters;
    const LightParts& light;
    const FacesBeforeLight<T>& faces;
    const std::vector<AlphaEdge>& alpha_edges;
    const Pieces& pieces;
};

// Casts a chunk of points on edges from their lights, to whatever lies behind: body(ShadowPoint, weight) is called for
// each border of a shadow there.
template <class T, class Body>
class ShadowChunk {
   public:
    ShadowChunk(const ShadowScene<T>& scene, uint64_t seed, Body body)
        : scene_(scene),
          sequence_(seed),
          wedge_(scene.view, scene.casters, scene.faces, scene.alpha_edges),
          light_rays_(scene.view, scene.casters, scene.light, scene.alpha_edges),
          body_(std::move(body)) {}

    // The i-th of places that ascend, with so many samples: a second one mirrors the first on the edge. How samples
    // fall to the two ends would make most of the noise where there are few on an edge.
    void add(int64_t i, double position, int64_t interval, double weight, int64_t samples) {
        const auto place = scene_.pieces.at(position, piece_);
        const ShadowPiece& piece = scene_.pieces[place.piece];
        if (place.piece != piece_) casts_ = wedge_.set(piece), piece_ = place.piece;
        if (!casts_) return;
        const Vec2 other = sequence_(uint64_t(i));
        // Along the edge before a point, else along the wedge.
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
    bool casts_ = false;  // whether that one does
    EdgeWedge<T> wedge_;
    LightRays<T> light_rays_;
    Body body_;
};

// The edges and alpha edges that cast shadows of a light.
template <class T>
class ShadowCasters {
   public:
    // expected  about how many samples there will be
    ShadowCasters(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, int64_t expected)
        : intervals_(std::clamp(expected / samples_of_interval, fewest_intervals, most_intervals)),
          faces_(view.scene, light, view.team),
          alpha_edges_(AlphaEdgeFinder<T>(casters).find(hash(view.options.seed, 13, gradient_stream), view.team)),
          pieces_(find(view, casters, light), view.team),
          scene_{view, casters, light, faces_, alpha_edges_, pieces_} {}

    bool empty() const { return pieces_.empty(); }
    const ShadowScene<T>& scene() const { return scene_; }
    int64_t intervals() const { return intervals_; }

    // Has places of each interval asked: body(ask) is called for some at a time, and calls ask(chunk) of a ShadowChunk.
    template <class Body>
    void draw_pilots(uint64_t seed, Body body) const {
        scene_.view.team.parallel_for((intervals_ + intervals_of_block - 1) / intervals_of_block, [&](int64_t block) {
            const int64_t first = block * intervals_of_block, last = std::min(first + intervals_of_block, intervals_);
            body([&](auto& chunk) {
                for (int64_t i = first; i < last; ++i) {
                    const double shift = to_unit(hash(seed, i));
                    for (int k = 0; k < pilots; ++k)
                        chunk.add(i * pilots + k, (double(i) + (k + shift) / pilots) / double(intervals_), i, 1, 1);
                }
                chunk.cast();
            });
        });
    }

   private:
    std::vector<ShadowPiece> find(const BackwardView<T>& view, const SceneView<T>& casters,
                                  const LightParts& light) const {
        std::vector<ShadowPiece> found =
            ShadowEdgeFinder<T>(view, casters, light, faces_, alpha_edges_).find(pair_tests);
        return light.extended ? cut(found, double(intervals_)) : found;
    }

    const int64_t intervals_;
    const FacesBeforeLight<T> faces_;
    const std::vector<AlphaEdge> alpha_edges_;
    const Pieces pieces_;
    const ShadowScene<T> scene_;
};

// The density of samples in each interval, from what pilots found: what those of one interval miss, those of its
// neighbours may have met, so most of the mean square is theirs.
inline Array<double> density_of(const std::vector<ShadowStatistics>& of_interval) {
    const auto count = int64_t(of_interval.size());
    Array<double> measure(count);
    double known = 0;
    for (int64_t i = 0; i < count; ++i) {
        double sub_camera = 0;
        const int64_t low = std::max<int64_t>(i - neighbours, 0), high = std::min(i + neighbours, count - 1);
        for (int64_t k = low; k <= high; ++k) sub_camera += of_interval[k].squares / double(high - low + 1);
        measure[i] = std::sqrt((own_share * of_interval[i].squares + (1 - own_share) * sub_camera) / pilots),
        known += measure[i] / double(count);
    }
    for (int64_t i = 0; i < count; ++i) measure[i] += floor_share * (known > 0 ? known : 1);
    return measure;
}

}  // namespace edgegrad
