// This file draws samples on secondary edges.
//
// Edges and alpha edges lie end to end by their length times the azimuths of lines past them (lune.h). Pilots measure
// the light that passes the edges of each connected part of the scene, by direction. The density of samples follows it,
// with a lower bound (line_pdf.h).

#include "secondary/secondary_edges.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "core/sampler.h"
#include "secondary/edge_line_source.h"
#include "secondary/estimator.h"
#include "secondary/line_ends.h"
#include "secondary/line_pdf.h"
#include "secondary/traced_edge_lines.h"
#include "shading/lit/indirect.h"
#include "shading/lit/lit.h"

namespace edgegrad {

namespace {

constexpr int64_t fewest_pilots = 1 << 10, most_pilots = 1 << 14, samples_of_pilot = 4, pilots_of_block = 1 << 8;

// EdgeLineSampler draws lines past edges and alpha edges, with a receiver at each end (estimator.h).
template <class T>
class EdgeLineSampler {
   public:
    EdgeLineSampler(const LineLight<T>& light, int64_t n)
        : light_(light),
          pilots_(std::clamp(n / samples_of_pilot, fewest_pilots, most_pilots)),
          pooled_(light.view.geometry.parts()),
          mirrors_(light.lit.lit, light.is_seen()),
          alpha_edges_(AlphaEdgeFinder<T>(light.casters).find(seed(Stream::edge_line_alpha_edges), light.view.team)) {}

    bool is_empty() const { return pieces() == 0; }

    // Fills pooled_ and sets its means.
    template <class Receiver>
    void cast_pilots(const Receiver& receiver) {
        const SystematicPlaces places(measure(), pilots_, to_unit(seed(Stream::edge_line_pilot_places)),
                                      light_.view.team);
        std::vector<PilotStatistics> found((places.size() + pilots_of_block - 1) / pilots_of_block);
        const int C = light_.lit.lit.channels;
        light_.view.team.parallel_for_with_state(
            int64_t(found.size()), [&] { return path_buffers(light_.lit.lit, light_.at_reflector); },
            [&](Paths& paths, int64_t block) {
                light_.view.team.check();
                PilotStatistics& own = found[block];
                LineEnds ends;
                const int64_t first = block * pilots_of_block, last = std::min(first + pilots_of_block, places.size());
                receiver.cast_pilots(
                    [&](auto body) {
                        trace(places, Stream::edge_line_pilots, first, last, body,
                              [&](int64_t cell) { own.lines.push_back(cell); });
                    },
                    [&](const EdgeLine& line, double size) {
                        if (!(size > 0)) return;
                        own.cell.push_back(line.segment), own.value.push_back(size);
                        ends.add(0, line.receiver, line.at.u, line.at.v);
                        ends.add(1, line.reflector, line.radiance_at.u, line.radiance_at.v);
                    });
                const std::vector<double> sent = ends.sent(light_, Stream::edge_line_pilot_paths, 2 * first, paths);
                for (size_t i = 0; i < own.value.size(); ++i) {
                    double most = 0;
                    for (int c = 0; c < C; ++c) most = std::max(most, std::fabs(sent[i * C + c]));
                    own.value[i] *= most;
                }
            });
        for (const PilotStatistics& own : found) {
            for (const int64_t cell : own.lines) pooled_.add_line(cell);
            for (size_t i = 0; i < own.cell.size(); ++i) pooled_.add(own.cell[i], own.value[i]);
        }
        means_ = pooled_.means();
    }

    int64_t lay_out(int64_t n) {
        places_.emplace(measure(), n, to_unit(seed(Stream::edge_line_places)), light_.view.team);
        return places_->size();
    }

    // Calls body(line, weight) for both ways along the lines.
    template <class Body>
    void trace(int64_t first, int64_t last, Body body) const {
        trace(*places_, Stream::edge_lines, first, last, body, [](int64_t) {});
    }

   private:
    struct PilotStatistics {
        std::vector<int64_t> lines, cell;  // cells of all lines, and of those that contribute
        std::vector<double> value;
    };

    uint64_t seed(Stream stream) const { return seed_of(light_.view.options.seed, stream); }
    const Topology& topology() const { return light_.view.geometry.topology(); }
    int64_t pieces() const { return topology().n_edges() + int64_t(alpha_edges_.size()); }
    EdgeLines<T> lines() const { return {light_.casters, topology(), alpha_edges_, pooled_, means_, mirrors_}; }

    // Returns the relative number of lines of each edge and alpha edge.
    Array<double> measure() const {
        Array<double> out(pieces());
        light_.view.team.parallel_for_blocks(pieces(), [&](int64_t, int64_t first, int64_t last) {
            EdgeLines<T> edge = lines();
            for (int64_t k = first; k < last; ++k) out[k] = edge.set(k);
        });
        return out;
    }

    // Calls body(line, weight) for both ways along the lines of places, and drawn(cell) with the cell of PooledLines of
    // each.
    template <class Body, class Drawn>
    void trace(const SystematicPlaces& places, Stream stream, int64_t first, int64_t last, Body body,
               Drawn drawn) const {
        const uint64_t random = seed(stream);
        const ShiftedSequence sequence(random);
        EdgeLines<T> edge = lines();
        TracedEdgeLines<T> traced(light_.view, light_.casters, alpha_edges_);
        int64_t current = -1;
        places.each(first, last, [&](int64_t i, int64_t piece, double along, double weight) {
            if (piece != current) edge.set(current = piece);
            const auto [t, w, area] = edge.at(along, sequence(uint64_t(i)), to_unit(hash(random, 1, uint64_t(i))));
            if (area == 0) return;
            const int64_t cell = edge.cell(w);
            drawn(cell);
            traced.add(piece, t, w, cell, weight * area);
            if (traced.is_full()) traced.cast(body);
        });
        traced.cast(body);
    }

    const LineLight<T>& light_;
    const int64_t pilots_;
    PooledLines pooled_;
    const Mirrors mirrors_;
    const std::vector<AlphaEdge> alpha_edges_;
    std::vector<double> means_;  // means of the cells of pooled_; empty until pilots are cast
    std::optional<SystematicPlaces> places_;
};

template <class T>
auto places_of(const BackwardView<T>& view) {
    return [&](int32_t i) { return vec(view.scene.verts + 3 * int64_t(i)); };
}
template <class T>
Vec3 normal_of(const BackwardView<T>& view, const EdgeLine& line) {
    return cross(line.occluder.sum(line.occluder.tangent, places_of(view)), line.w);
}

// Appends a line with ends that need not be seen: F is by world coordinates, with y₁ at fixed barycentrics
// (edge_line_source.h).
template <class T>
void append_indirect(const BackwardView<T>& view, const EdgeLine& line, double weight, CurveRecords& records) {
    const int64_t sample = records.size();
    const Vec3 N = normal_of(view, line);
    append(records.x, {0.0, 0.0});
    for (int k = 0; k < CurveRecords::surfaces; ++k) {
        const Barycentrics b = k == 0 ? line.at : line.radiance_at;
        records.face.push_back(k == 0 ? line.receiver : k == 1 ? line.reflector : -2);
        records.factor.push_back(k == 0 ? weight : 0), append(records.b, {b.u, b.v});
    }
    const auto add = [&](int32_t vertex, double by) {
        records.row_of.push_back(sample), records.vertex.push_back(vertex);
        append(records.by_q, {by * N.x, by * N.y, by * N.z});
    };
    for (int i = 0; i < 3; ++i) {
        add(view.scene.faces[3 * int64_t(line.receiver) + i], line.share * line.at[i]);
        add(view.scene.faces[3 * int64_t(line.reflector) + i], (1 - line.share) * line.from[i]);
    }
    const Occluder& occluder = line.occluder;
    for (int i = 0; i < occluder.count; ++i) add(occluder.vertex[i], -occluder.weight[i]);
    if (occluder.is_alpha_edge()) occluder.append_alpha_edge(occluder.turned(line.w, places_of(view)), sample, records);
}

}  // namespace

template <class T>
void add_secondary_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& lit, int64_t samples,
                         const Record& record, GradientSink& to, SecondaryEdgeSamples& out) {
    const int64_t n = samples >= 0 ? samples : default_secondary_samples(view);
    if (n == 0) return;
    const LineLight<T> light(view, casters, lit);
    EdgeLineSampler<T> sampler(light, n);
    const size_t before = to.records->curves.size();
    const auto estimate = [&](const auto& receiver) {
        record_secondary(view, sampler, receiver, [&] { return n; }, to);
    };
    if (lit.seen) {
        // Pilots count by the motion of each edge's image with the edge or the receiver.
        const auto pilot = [&](const auto&, const auto& sample) {
            const double moved = length(sample.N) + length(sample.m), look = view.importance.mean(sample.x, sample.x);
            return sample.weight * sample.scale * sample.area_scale * moved * look;
        };
        estimate(CurvesInView(view, EdgeLineSource<T>(view, lit.options.near), record, pilot));
    } else {
        estimate(CurvesOnSurfaces(
            [&](const EdgeLine& line, double weight, CurveRecords& records) {
                append_indirect(view, line, weight, records);
            },
            [&](const EdgeLine& line, double weight) { return weight * length(normal_of(view, line)); }));
    }
    light_reflectors(light, to.records->curves, before, Stream::edge_line_paths, out);
}

template void add_secondary_edges(const BackwardView<float>&, const SceneView<float>&, const LitPaths&, int64_t,
                                  const Record&, GradientSink&, SecondaryEdgeSamples&);
template void add_secondary_edges(const BackwardView<double>&, const SceneView<double>&, const LitPaths&, int64_t,
                                  const Record&, GradientSink&, SecondaryEdgeSamples&);

}  // namespace edgegrad
