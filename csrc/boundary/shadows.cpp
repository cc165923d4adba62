// Samples on the borders of shadows.
//
// Pieces of edges before parts of the light (shadow_edges.h) are laid end to end by what is known of their shadows
// without a ray. Equal intervals of that measure take some rays each, pilots, from the light past the edge to whatever
// they meet, and from the camera to there, which say how long the border's image is, how far it moves with the edge,
// and how much light ends there. The samples go in proportion to the root mean square of that product over an interval,
// with a floor.

#include "boundary/shadows.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "boundary/contractions.h"
#include "boundary/curve_samples.h"
#include "boundary/light_rays.h"
#include "boundary/shadow_edges.h"
#include "boundary/shadow_source.h"
#include "core/sampler.h"
#include "core/systematic.h"

namespace edgegrad {

namespace {

constexpr int64_t pair_tests = 1 << 22;  // of edges before parts of the light
constexpr int64_t fewest_intervals = 1 << 10, most_intervals = 1 << 15, samples_of_interval = 16;
constexpr int64_t intervals_of_block = 64;
constexpr double most_of_edge = 64;     // pieces
constexpr int pilots = 4;               // places of an interval
constexpr int64_t neighbours = 16;      // of an interval, on either side
constexpr int64_t mirrored = 2;         // samples of a place before a light with an extent
constexpr double own_share = 0.3;       // of the mean square that is the interval's own
constexpr double floor_share = 0.1;     // of the density that pilots do not decide
constexpr double samples_a_pixel = 24;  // of the border of a point's shadow
constexpr int64_t fewest_samples = 256, most_samples = 1 << 18;

// Samples run along the light's wedges, and where on the edge is drawn: so edges that make up much of the measure are
// cut.
std::vector<ShadowPiece> cut(const std::vector<ShadowPiece>& pieces, double intervals) {
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
    Pieces(std::vector<ShadowPiece> pieces, Team& team)
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

// Whether the filter of a pixel reaches x, and what is there belongs to this window.
template <class T>
bool is_in_view(const BackwardView<T>& view, Vec3 y) {
    return view.camera.depth_weight(y) > 0 && view.volume.outcode(y) == 0;
}

// What pilots find of an interval: sums over them.
struct Found {
    double squares = 0;  // (swept area · light)²
    double length = 0;   // px
};

// The contraction of pilots.
template <class T>
class Pilots {
   public:
    Pilots(const BackwardView<T>& view, const LightParts& light, std::vector<Found>& found)
        : view_(view), light_(light), found_(found) {}

    bool wants(int, Vec2) const { return true; }

    void add(int, ShadowSource<T>& source, typename ShadowSource<T>::Sample& sample) {
        const ShadowPoint& point = sample.shadow;
        const Vec3 y = source.place_of(point), m = sample.m, light = source.light_of(point);
        const Vec3 d = light_.infinite ? light : light - y;
        const double cosine = std::fabs(dot(m, d)) / (length(m) * length(d));
        Vec3 there;
        for (int i = 0; i < 3; ++i) there += point.on[i] * corner(view_.scene, point.face, i);
        const double arriving = cosine * light_.towards(point.part, point.light, there);
        const double look = view_.importance.mean(sample.x, sample.x);
        // The area that the border sweeps as the edge moves: where light grazes a face it is much for little length.
        double by_caster = sample.by_caster[0] + sample.by_caster[1];
        if (point.caster.is_rim()) by_caster += sample.by_caster[2];
        const double swept = std::fabs(sample.weight * sample.scale * sample.area_scale) * by_caster * length(sample.N);
        const double px = sample.weight * sample.speed * std::sqrt(std::fabs(sample.area_scale));
        const double value = swept * arriving * look;
        if (!std::isfinite(value)) return;
        found_[point.segment].squares += value * value, found_[point.segment].length += look > 0 ? px : 0;
    }

   private:
    const BackwardView<T>& view_;
    const LightParts& light_;
    std::vector<Found>& found_;
};

// Where the samples lie: n places in proportion to a density that is constant in equal intervals of the pieces'
// positions. They are equally spaced; but those of a piece that is due at least one are then spread evenly from end to
// end of it, each somewhere in its share. By how many places the piece has, more or less than it is due, vertices would
// otherwise differ most. For each number of places the mean over where they lie is right.
class Places {
   public:
    // density  one number for each interval; becomes its running sum
    // whole    whether pieces get whole numbers of places
    Places(const Pieces& pieces, Array<double>& density, int64_t n, bool whole, uint64_t seed, Team& team)
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
    const std::vector<Rim>& rims;
    const Pieces& pieces;
};

// Casts a chunk of points on edges from their lights, and from the camera what they are seen to meet.
template <class T, class Contraction>
class ShadowChunk {
   public:
    ShadowChunk(const ShadowScene<T>& scene, uint64_t seed, Contraction& contraction)
        : scene_(scene),
          sequence_(seed),
          wedge_(scene.view, scene.casters, scene.faces, scene.rims),
          source_(scene.view, scene.light.infinite),
          light_rays_(scene.view, scene.casters, scene.light, scene.rims),
          samples_(scene.view, source_, contraction) {}

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
    void finish(ChunkGrad& grad) {
        cast();
        samples_.finish(grad);
    }

   private:
    void cast() {
        light_rays_.cast([&](const ShadowPoint& point, double weight) {
            if (is_in_view(scene_.view, source_.place_of(point))) samples_.add(point, 0, weight);
        });
    }

    const ShadowScene<T> scene_;
    const ShiftedSequence sequence_;
    int64_t piece_ = -1;
    bool casts_ = false;  // whether that one does
    EdgeWedge<T> wedge_;
    ShadowSource<T> source_;
    LightRays<T> light_rays_;
    CurveSamples<Contraction, T, ShadowSource<T>> samples_;
};

}  // namespace

int64_t most_shadow_samples(int64_t width, int64_t height, int spp) {
    return std::clamp(width * height * spp / 8, fewest_samples, most_samples);
}

template <class T>
void add_shadows(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light, int64_t samples,
                 const Record& record, Destination& to, BackwardProfile& profile) {
    // No more rays than an eighth of the image's, for each is one of a light and one of the camera, alone; and so many
    // where the light has an extent, for each of its points casts a shadow of its own.
    const int64_t most = most_shadow_samples(view.camera.width, view.camera.height, view.image.spp);
    const int64_t expected = samples >= 0 ? samples : light.extended ? most : 0;
    const int64_t count = std::clamp(expected / samples_of_interval, fewest_intervals, most_intervals);
    const FacesBeforeLight<T> faces(view.scene, light, view.team);
    const std::vector<Rim> rims = RimFinder<T>(casters).find(hash(view.options.seed, 13, gradient_stream), view.team);
    std::vector<ShadowPiece> found = ShadowEdgeFinder<T>(view, casters, light, faces, rims).find(pair_tests);
    if (light.extended) found = cut(found, double(count));
    const Pieces pieces(std::move(found), view.team);
    if (pieces.empty()) return;

    const ShadowScene<T> scene{view, casters, light, faces, rims, pieces};
    std::vector<Found> of_interval(count);
    const uint64_t pilot_seed = hash(view.options.seed, 10, gradient_stream);
    view.team.each((count + intervals_of_block - 1) / intervals_of_block, [&](int64_t block) {
        ChunkGrad unused;
        Pilots pilots_of_block(view, light, of_interval);
        ShadowChunk chunk(scene, mix(pilot_seed), pilots_of_block);
        const int64_t first = block * intervals_of_block, last = std::min(first + intervals_of_block, count);
        for (int64_t i = first; i < last; ++i) {
            const double shift = to_unit(hash(pilot_seed, i));
            for (int k = 0; k < pilots; ++k)
                chunk.add(i * pilots + k, (double(i) + (k + shift) / pilots) / double(count), i, 1, 1);
        }
        chunk.finish(unused);
    });
    Array<double> measure(count);
    double known = 0, length = 0;  // of the border, px, a mean over the light
    // What pilots of one interval miss, those of its neighbours may have met: most of the mean square is theirs.
    for (int64_t i = 0; i < count; ++i) {
        double window = 0;
        const int64_t low = std::max<int64_t>(i - neighbours, 0), high = std::min(i + neighbours, count - 1);
        for (int64_t k = low; k <= high; ++k) window += of_interval[k].squares / double(high - low + 1);
        measure[i] = std::sqrt((own_share * of_interval[i].squares + (1 - own_share) * window) / pilots),
        known += measure[i] / double(count);
        length += of_interval[i].length / double(pilots * count);
    }
    for (int64_t i = 0; i < count; ++i) measure[i] += floor_share * (known > 0 ? known : 1);
    const int64_t wanted = light.extended ? most : int64_t(std::min(samples_a_pixel * length, 1e15));
    const int64_t n = samples >= 0 ? samples : std::clamp(wanted, fewest_samples, most);
    profile.shadow_samples += n;
    if (view.options.dry || n == 0) return;
    const int64_t samples_of_place = light.extended ? mirrored : 1,
                  places = (n + samples_of_place - 1) / samples_of_place;
    const Places drawn(pieces, measure, places, light.extended, hash(view.options.seed, 11, gradient_stream),
                       view.team);
    double seconds[2] = {};
    view.scatter.add(places, to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        const std::unique_ptr<CurveContraction> to_chunk = contract_curves(view, record, grad);
        ShadowChunk chunk(scene, hash(view.options.seed, 9, gradient_stream), *to_chunk);
        Places place(drawn);
        for (int64_t i = first; i < last; ++i) {
            const auto [position, interval, weight] = place(i);
            chunk.add(i, position, interval, weight, samples_of_place);
        }
        chunk.finish(grad);
    });
}

template void add_shadows(const BackwardView<float>&, const SceneView<float>&, const LightParts&, int64_t,
                          const Record&, Destination&, BackwardProfile&);
template void add_shadows(const BackwardView<double>&, const SceneView<double>&, const LightParts&, int64_t,
                          const Record&, Destination&, BackwardProfile&);

}  // namespace edgegrad
