// Samples on the borders of what surfaces of a path see of one another.
//
// Edges are laid end to end by their length times the azimuths of lines past them (lune.h). Some lines, pilots, say how
// much light passes by the edges of each connected part of the scene, direction by direction; the samples go in
// proportion to that, with a floor (line_density.h).

#include "boundary/bounces.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "boundary/bounce_lines.h"
#include "boundary/bounce_source.h"
#include "boundary/contractions.h"
#include "boundary/curve_samples.h"
#include "boundary/line_density.h"
#include "core/sampler.h"
#include "core/systematic.h"
#include "shading/lit/between.h"
#include "shading/lit/indirect.h"
#include "shading/lit/lit.h"

namespace edgegrad {

namespace {

constexpr int64_t fewest_samples = 256, most_samples = 1 << 18;
constexpr int64_t fewest_pilots = 1 << 10, most_pilots = 1 << 14, samples_of_pilot = 4, pilots_of_block = 1 << 8;

// Whether the filter of a pixel reaches x, and what is there belongs to this window.
template <class T>
bool is_in_view(const BackwardView<T>& view, Vec3 y) {
    return view.camera.depth_weight(y) > 0 && view.volume.outcode(y) == 0;
}

// What chunks of lines share.
template <class T>
struct LineScene {
    const BackwardView<T>& view;
    const SceneView<T>& casters;
    const LitPaths& lit;
    LitOptions at_sender;  // that light is scattered once less there than in all
    PooledLines& pooled;
    std::vector<double> means = {};  // of its cells; empty: not known yet

    LineScene(const BackwardView<T>& view_, const SceneView<T>& casters_, const LitPaths& lit_, PooledLines& pooled_)
        : view(view_), casters(casters_), lit(lit_), at_sender(lit_.options), pooled(pooled_) {
        --at_sender.bounces;
    }
    EdgeLines<T> lines() const { return {view.scene, view.geometry.topology(), pooled, means}; }

    // What is drawn of each edge, relative to others.
    Array<double> measure() const {
        const int64_t n = view.geometry.topology().n_edges();
        Array<double> out(n);
        view.team.each_block(n, [&](int64_t, int64_t first, int64_t last) {
            EdgeLines<T> edge = lines();
            for (int64_t k = first; k < last; ++k) out[k] = edge.set(k);
        });
        return out;
    }
};

// Pairs of points, a receiver and a sender of light each.
class Ends {
   public:
    int64_t size() const { return int64_t(face_[0].size()); }
    void add(int receiver_or_sender, int64_t face, double u, double v) {
        face_[receiver_or_sender].push_back(face), append(b_[receiver_or_sender], {1 - u - v, u, v});
    }

    // (N, channels) what passes between them (between.h), with the numbers of so many pairs from `first` on.
    template <class T>
    std::vector<double> sent(const LineScene<T>& scene, uint64_t stream, int64_t first, Paths& paths) const {
        const int C = scene.lit.lit.channels;
        std::vector<double> out(size() * C);
        std::vector<int64_t> seed;
        const uint64_t numbers = hash(scene.view.options.seed, stream, gradient_stream) << 32;
        for (int64_t i = 0; i < size(); ++i) seed.push_back(int64_t(numbers | uint32_t(first + i)));
        for (int64_t i = 0; i < size(); i += shaded_at_once) {
            const LitLines some{std::min(shaded_at_once, size() - i),
                                &face_[0][i],
                                &face_[1][i],
                                &b_[0][3 * i],
                                &b_[1][3 * i],
                                &seed[i]};
            send_between(scene.lit.lit, scene.casters, scene.view.geometry.caster(), some, paths, &out[i * C]);
        }
        return out;
    }

   private:
    std::vector<int64_t> face_[2];
    std::vector<double> b_[2];
};

// The contraction of pilots: which of them are seen, and how much the border of each moves.
template <class T>
class Pilots {
   public:
    explicit Pilots(const BackwardView<T>& view) : view_(view) {}

    bool wants(int, Vec2) const { return true; }

    void add(int, BounceSource<T>&, typename BounceSource<T>::Sample& sample) {
        const BounceLine& line = sample.line;
        // As its edge moves, or the receiver.
        const double moved = length(sample.N) + length(sample.m);
        const double look = view_.importance.mean(sample.x, sample.x);
        const double size = sample.weight * sample.scale * sample.area_scale * moved * look;
        if (!(size > 0)) return;
        cell.push_back(line.segment), value.push_back(size);
        ends.add(0, line.receiver, line.at.u, line.at.v), ends.add(1, line.sender, line.asked.u, line.asked.v);
    }

    std::vector<int64_t> cell;  // of PooledLines
    std::vector<double> value;
    Ends ends;

   private:
    const BackwardView<T>& view_;
};

// Casts a chunk of lines past edges, and from the camera what they are seen to meet.
template <class T, class Contraction>
class BounceChunk {
   public:
    BounceChunk(const LineScene<T>& scene, const Systematic& edges, uint64_t seed, Contraction& contraction)
        : scene_(scene),
          edges_(edges),
          sequence_(seed),
          edge_lines_(scene.lines()),
          source_(scene.view),
          lines_(scene.view, scene.casters),
          samples_(scene.view, source_, contraction) {}

    // The i-th line, at a position along the edges; these ascend. The cell that it is pooled in.
    int64_t add(int64_t i, double position) {
        const int64_t k = edge_ < 0 ? edges_.primitive(position) : edges_.primitive(position, edge_);
        if (k != edge_) edge_ = k, edge_lines_.set(k);
        const double along = std::clamp((position - edges_.begin_of(k)) / edges_.measure_of(k), 0.0, 1.0);
        const auto [t, w, area] = edge_lines_.at(along, sequence_(uint64_t(i)));
        const int64_t cell = edge_lines_.cell(w);
        lines_.add(k, t, w, cell, edges_.weight(k) * area);
        if (lines_.is_full()) cast();
        return cell;
    }
    void finish(ChunkGrad& grad) {
        cast();
        samples_.finish(grad);
    }

   private:
    void cast() {
        lines_.cast([&](const BounceLine& line, double weight) {
            if (is_in_view(scene_.view, source_.place_of(line))) samples_.add(line, 0, weight);
        });
    }

    const LineScene<T>& scene_;
    const Systematic& edges_;
    const ShiftedSequence sequence_;
    int64_t edge_ = -1;
    EdgeLines<T> edge_lines_;
    BounceSource<T> source_;
    BounceLines<T> lines_;
    CurveSamples<Contraction, T, BounceSource<T>> samples_;
};

// Fills what is pooled.
template <class T>
void cast_pilots(LineScene<T>& scene, int64_t n) {
    const BackwardView<T>& view = scene.view;
    Array<double> measure = scene.measure();
    Systematic edges(measure, view.team);
    if (!(edges.total() > 0)) return;
    edges.draw(n, to_unit(hash(view.options.seed, 17, gradient_stream)));
    struct Found {
        std::vector<int64_t> lines, cell;  // cells of all lines, and of those that give something
        std::vector<double> value;
    };
    std::vector<Found> found((n + pilots_of_block - 1) / pilots_of_block);
    const int C = scene.lit.lit.channels;
    view.team.each_with(
        int64_t(found.size()), [&] { return path_buffers(scene.lit.lit, scene.at_sender); },
        [&](Paths& paths, int64_t block) {
            view.team.check();
            Pilots<T> pilots(view);
            BounceChunk chunk(scene, edges, hash(view.options.seed, 18, gradient_stream), pilots);
            Found& own = found[block];
            const int64_t first = block * pilots_of_block, last = std::min(first + pilots_of_block, n);
            for (int64_t i = first; i < last; ++i) own.lines.push_back(chunk.add(i, edges.position(i)));
            ChunkGrad unused;
            chunk.finish(unused);
            const std::vector<double> sent = pilots.ends.sent(scene, 19, 2 * first, paths);
            own.cell = std::move(pilots.cell), own.value = std::move(pilots.value);
            for (size_t i = 0; i < own.value.size(); ++i) {
                double most = 0;
                for (int c = 0; c < C; ++c) most = std::max(most, std::fabs(sent[i * C + c]));
                own.value[i] *= most;
            }
        });
    for (const Found& own : found) {
        for (const int64_t cell : own.lines) scene.pooled.add_line(cell);
        for (size_t i = 0; i < own.cell.size(); ++i) scene.pooled.add(own.cell[i], own.value[i]);
    }
    scene.means = scene.pooled.means();
}

// (S, channels): by how much the image jumps at the samples of a record, of which the first is number `first`.
template <class T>
std::vector<double> jumps_of(const LineScene<T>& scene, const CurveRecords& record, int64_t first, Paths& paths) {
    constexpr int surfaces = CurveRecords::surfaces;
    Ends ends;
    for (int64_t i = 0; i < record.size(); ++i)
        for (int k = 0; k < 2; ++k) {
            const int64_t at = surfaces * i + k;
            ends.add(k, record.face[at], record.b[2 * at], record.b[2 * at + 1]);
        }
    std::vector<double> out = ends.sent(scene, 15, first, paths);
    const int C = scene.lit.lit.channels;
    for (int64_t i = 0; i < record.size(); ++i)
        for (int c = 0; c < C; ++c) out[i * C + c] *= record.factor[surfaces * i];
    return out;
}

}  // namespace

int64_t most_bounce_samples(int64_t width, int64_t height, int spp) {
    return std::clamp(width * height * spp / 8, fewest_samples, most_samples);
}

template <class T>
void add_bounces(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& lit, int64_t samples,
                 const Record& record, Destination& to, std::vector<std::vector<double>>& jumps) {
    const int64_t n =
        samples >= 0 ? samples : most_bounce_samples(view.camera.width, view.camera.height, view.image.spp);
    if (n == 0) return;
    PooledLines pooled(view.geometry.parts());
    LineScene<T> scene(view, casters, lit, pooled);
    cast_pilots(scene, std::clamp(n / samples_of_pilot, fewest_pilots, most_pilots));
    Array<double> measure = scene.measure();
    Systematic edges(measure, view.team);
    if (!(edges.total() > 0)) return;
    edges.draw(n, to_unit(hash(view.options.seed, 14, gradient_stream)));
    double seconds[2] = {};
    const size_t before = to.records->curves.size();
    view.scatter.add(n, to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        const std::unique_ptr<CurveContraction> to_chunk = contract_curves(view, record, grad);
        BounceChunk chunk(scene, edges, hash(view.options.seed, 16, gradient_stream), *to_chunk);
        for (int64_t i = first; i < last; ++i) chunk.add(i, edges.position(i));
        chunk.finish(grad);
    });
    const std::vector<CurveRecords>& found = to.records->curves;
    std::vector<int64_t> first(found.size() + 1, 0);
    for (size_t k = before; k < found.size(); ++k) first[k + 1] = first[k] + found[k].size();
    jumps.resize(found.size());
    view.team.each_with(
        int64_t(found.size() - before), [&] { return path_buffers(lit.lit, scene.at_sender); },
        [&](Paths& paths, int64_t i) {
            view.team.check();
            const size_t k = before + size_t(i);
            jumps[k] = jumps_of(scene, found[k], first[k], paths);
        });
}

template void add_bounces(const BackwardView<float>&, const SceneView<float>&, const LitPaths&, int64_t, const Record&,
                          Destination&, std::vector<std::vector<double>>&);
template void add_bounces(const BackwardView<double>&, const SceneView<double>&, const LitPaths&, int64_t,
                          const Record&, Destination&, std::vector<std::vector<double>>&);

}  // namespace edgegrad
