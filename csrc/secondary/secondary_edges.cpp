// Samples on the borders of what surfaces of a path see of one another.
//
// Edges and alpha edges are laid end to end by their length times the azimuths of lines past them (lune.h). Some
// lines, pilots, say how much light passes by those of each connected part of the scene, direction by direction; the
// samples go in proportion to that, with a lower bound (line_pdf.h).

#include "secondary/secondary_edges.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "boundary/accumulation.h"
#include "boundary/curve_samples.h"
#include "core/sampler.h"
#include "core/systematic.h"
#include "secondary/edge_line_source.h"
#include "secondary/line_ends.h"
#include "secondary/line_pdf.h"
#include "secondary/traced_edge_lines.h"
#include "shading/lit/indirect.h"
#include "shading/lit/lit.h"

namespace edgegrad {

namespace {

constexpr int64_t fewest_samples = 256, most_samples = 1 << 18;
constexpr int64_t fewest_pilots = 1 << 10, most_pilots = 1 << 14, samples_of_pilot = 4, pilots_of_block = 1 << 8;

// What chunks of lines share.
template <class T>
struct LineScene : LineLight<T> {
    PooledLines& pooled;
    Mirrors mirrors;
    const std::vector<AlphaEdge> alpha_edges;
    std::vector<double> means = {};  // of its cells; empty: not known yet

    LineScene(const LineLight<T>& light, PooledLines& pooled_)
        : LineLight<T>(light),
          pooled(pooled_),
          mirrors(this->lit.lit, this->is_seen()),
          alpha_edges(AlphaEdgeFinder<T>(this->casters)
                          .find(hash(this->view.options.seed, 13, gradient_stream), this->view.team)) {}
    EdgeLines<T> lines() const {
        return {this->casters, this->view.geometry.topology(), alpha_edges, pooled, means, mirrors};
    }

    // What is drawn of each edge and alpha edge, relative to others.
    Array<double> measure() const {
        const int64_t n = this->view.geometry.topology().n_edges() + int64_t(alpha_edges.size());
        Array<double> out(n);
        this->view.team.parallel_for_blocks(n, [&](int64_t, int64_t first, int64_t last) {
            EdgeLines<T> edge = lines();
            for (int64_t k = first; k < last; ++k) out[k] = edge.set(k);
        });
        return out;
    }
};

// What pilots find.
struct Pilots {
    std::vector<int64_t> cell;  // of PooledLines
    std::vector<double> value;
    Ends ends;

    void add(const EdgeLine& line, double size) {
        if (!(size > 0)) return;
        cell.push_back(line.segment), value.push_back(size);
        ends.add(0, line.receiver, line.at.u, line.at.v), ends.add(1, line.reflector, line.asked.u, line.asked.v);
    }
};

// Their accumulation: which of them are seen, and how much the border of each moves, with its edge or the receiver.
template <class T>
class SeenPilots {
   public:
    SeenPilots(const BackwardView<T>& view, Pilots& found) : view_(view), found_(found) {}

    bool wants(int, Vec2) const { return true; }
    void add(int, EdgeLineSource<T>&, typename EdgeLineSource<T>::Sample& sample) {
        const double moved = length(sample.N) + length(sample.m), look = view_.importance.mean(sample.x, sample.x);
        found_.add(sample.line, sample.weight * sample.scale * sample.area_scale * moved * look);
    }

   private:
    const BackwardView<T>& view_;
    Pilots& found_;
};

// Calls body(line, weight) for both ways along the lines of a chunk.
template <class T, class Body>
class LineChunk {
   public:
    LineChunk(const LineScene<T>& scene, const Systematic& edges, uint64_t seed, Body body)
        : edges_(edges),
          seed_(seed),
          sequence_(seed),
          body_(body),
          edge_lines_(scene.lines()),
          lines_(scene.view, scene.casters, scene.alpha_edges) {}

    // The i-th line, at a position along the edges; these ascend. The cell that it is pooled in.
    int64_t add(int64_t i, double position) {
        const int64_t k = edge_ < 0 ? edges_.primitive(position) : edges_.primitive(position, edge_);
        if (k != edge_) edge_ = k, edge_lines_.set(k);
        const double along = std::clamp((position - edges_.begin_of(k)) / edges_.measure_of(k), 0.0, 1.0);
        const auto [t, w, area] = edge_lines_.at(along, sequence_(uint64_t(i)), to_unit(hash(seed_, 1, uint64_t(i))));
        const int64_t cell = edge_lines_.cell(w);
        if (area == 0) return cell;
        lines_.add(k, t, w, cell, edges_.weight(k) * area);
        if (lines_.is_full()) cast();
        return cell;
    }
    void cast() { lines_.cast(body_); }

   private:
    const Systematic& edges_;
    const uint64_t seed_;
    const ShiftedSequence sequence_;
    const Body body_;
    int64_t edge_ = -1;
    EdgeLines<T> edge_lines_;
    TracedEdgeLines<T> lines_;
};

// Calls lines(body) with a body that gives the accumulation those of which the camera sees an end.
template <class T, class Accumulation, class Lines>
void each_seen(const BackwardView<T>& view, double near, Accumulation& accumulation, LocalGradients& grad,
               Lines lines) {
    EdgeLineSource<T> source(view, near);
    CurveSamples samples(view, source, accumulation);
    lines([&](const EdgeLine& line, double weight) {
        if (is_in_view(view, source.place_of(line))) samples.add(line, 0, weight);
    });
    samples.finish(grad);
}

template <class T>
auto places_of(const BackwardView<T>& view) {
    return [&](int32_t i) { return vec(view.scene.verts + 3 * int64_t(i)); };
}
template <class T>
Vec3 normal_of(const BackwardView<T>& view, const EdgeLine& line) {
    return cross(line.occluder.sum(line.occluder.tangent, places_of(view)), line.w);
}

// A line of which no end need be seen: F by places in the world, y₁ stays at its barycentrics (edge_line_source.h).
template <class T>
void append_indirect(const BackwardView<T>& view, const EdgeLine& line, double weight, CurveRecords& records) {
    const int64_t sample = records.size();
    const Vec3 N = normal_of(view, line);
    append(records.x, {0.0, 0.0});
    for (int k = 0; k < CurveRecords::surfaces; ++k) {
        const Barycentrics b = k == 0 ? line.at : line.asked;
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

// Fills what is pooled.
template <class T>
void cast_pilots(LineScene<T>& scene, int64_t n) {
    const BackwardView<T>& view = scene.view;
    Array<double> measure = scene.measure();
    Systematic edges(measure, view.team);
    if (!(edges.total() > 0)) return;
    edges.draw(n, to_unit(hash(view.options.seed, 17, gradient_stream)));
    struct PilotStatistics {
        std::vector<int64_t> lines, cell;  // cells of all lines, and of those that give something
        std::vector<double> value;
    };
    std::vector<PilotStatistics> found((n + pilots_of_block - 1) / pilots_of_block);
    const int C = scene.lit.lit.channels;
    view.team.parallel_for_with_state(
        int64_t(found.size()), [&] { return path_buffers(scene.lit.lit, scene.at_reflector); },
        [&](Paths& paths, int64_t block) {
            view.team.check();
            Pilots pilots;
            PilotStatistics& own = found[block];
            const int64_t first = block * pilots_of_block, last = std::min(first + pilots_of_block, n);
            const auto lines = [&](auto body) {
                LineChunk chunk(scene, edges, hash(view.options.seed, 18, gradient_stream), body);
                for (int64_t i = first; i < last; ++i) own.lines.push_back(chunk.add(i, edges.position(i)));
                chunk.cast();
            };
            if (scene.is_seen()) {
                LocalGradients unused;
                SeenPilots seen(view, pilots);
                each_seen(view, scene.lit.options.near, seen, unused, lines);
            } else {
                lines([&](const EdgeLine& line, double weight) {
                    pilots.add(line, weight * length(normal_of(view, line)));
                });
            }
            const std::vector<double> sent = pilots.ends.sent(scene, 19, 2 * first, paths);
            own.cell = std::move(pilots.cell), own.value = std::move(pilots.value);
            for (size_t i = 0; i < own.value.size(); ++i) {
                double most = 0;
                for (int c = 0; c < C; ++c) most = std::max(most, std::fabs(sent[i * C + c]));
                own.value[i] *= most;
            }
        });
    for (const PilotStatistics& own : found) {
        for (const int64_t cell : own.lines) scene.pooled.add_line(cell);
        for (size_t i = 0; i < own.cell.size(); ++i) scene.pooled.add(own.cell[i], own.value[i]);
    }
    scene.means = scene.pooled.means();
}

}  // namespace

int64_t most_secondary_edge_samples(int64_t width, int64_t height, int spp) {
    return std::clamp(width * height * spp / 8, fewest_samples, most_samples);
}

template <class T>
void add_secondary_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& lit, int64_t samples,
                         const Record& record, GradientSink& to, SecondaryEdgeSamples& out) {
    const int64_t n =
        samples >= 0 ? samples : most_secondary_edge_samples(view.camera.width, view.camera.height, view.image.spp);
    if (n == 0) return;
    PooledLines pooled(view.geometry.parts());
    LineScene<T> scene({view, casters, lit}, pooled);
    cast_pilots(scene, std::clamp(n / samples_of_pilot, fewest_pilots, most_pilots));
    Array<double> measure = scene.measure();
    Systematic edges(measure, view.team);
    if (!(edges.total() > 0)) return;
    edges.draw(n, to_unit(hash(view.options.seed, 14, gradient_stream)));
    double seconds[2] = {};
    const size_t before = to.records->curves.size();
    view.scatter.add(n, to, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
        const auto lines = [&](auto body) {
            LineChunk chunk(scene, edges, hash(view.options.seed, 16, gradient_stream), body);
            for (int64_t i = first; i < last; ++i) chunk.add(i, edges.position(i));
            chunk.cast();
        };
        if (scene.is_seen()) {
            each_seen(view, lit.options.near, *accumulate_curves(view, record, grad), grad, lines);
        } else {
            lines(
                [&](const EdgeLine& line, double weight) { append_indirect(view, line, weight, grad.records.curves); });
        }
    });
    light_reflectors(scene, to.records->curves, before, 15, out);
}

template void add_secondary_edges(const BackwardView<float>&, const SceneView<float>&, const LitPaths&, int64_t,
                                  const Record&, GradientSink&, SecondaryEdgeSamples&);
template void add_secondary_edges(const BackwardView<double>&, const SceneView<double>&, const LitPaths&, int64_t,
                                  const Record&, GradientSink&, SecondaryEdgeSamples&);

}  // namespace edgegrad
