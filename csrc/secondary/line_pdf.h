// This file holds the pdf of lines past edges and alpha edges. It follows the light that passes along them, as far as
// that is known.
//
// Edges of one connected part see almost the same light along parallel lines, and each of many edges has few lines.
// Pilot results are therefore pooled by connected part and by cell of directions. Where faces are glossy, some lines
// are drawn by their mirror lobes (specular_lines.h). Either strategy could draw any line, so their pdfs are mixed.
#pragma once

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "estimator/view.h"
#include "rays/plane_hit.h"
#include "secondary/lune.h"
#include "secondary/occluder.h"
#include "secondary/specular_lines.h"

namespace edgegrad {

// DirectionCells divides unoriented directions by where they pass three sides of a cube around the origin.
struct DirectionCells {
    static constexpr int across = 6, count = 3 * across * across;

    static int of(Vec3 w) {
        const double x = std::fabs(w.x), y = std::fabs(w.y), z = std::fabs(w.z);
        if (x >= y && x >= z) return in_side(0, w.y / w.x, w.z / w.x);
        return y >= z ? in_side(1, w.z / w.y, w.x / w.y) : in_side(2, w.x / w.z, w.y / w.z);
    }

   private:
    static int in_side(int side, double a, double b) {
        const auto index = [](double c) { return std::clamp(int((c + 1) / 2 * across), 0, across - 1); };
        return (side * across + index(a)) * across + index(b);
    }
};

// PooledLines holds root mean squares of the lines' contributions, by part and direction.
class PooledLines {
   public:
    explicit PooledLines(const ConnectedParts& parts)
        : parts_(parts),
          tables_(std::min<int64_t>(parts.size(), most_tables)),
          squares_(tables_ * DirectionCells::count, 0.0),
          lines_(squares_.size(), 0) {}

    // Returns the cell of a line along w past an edge at a vertex.
    int64_t cell(int32_t vertex, Vec3 w) const {
        return parts_.of(vertex) * tables_ / parts_.size() * DirectionCells::count + DirectionCells::of(w);
    }
    void add_line(int64_t cell) { ++lines_[cell]; }
    void add(int64_t cell, double value) {
        if (std::isfinite(value)) squares_[cell] += value * value;
    }
    // Returns the root mean squares once all lines are added. Each is raised by a fraction of the overall one.
    std::vector<double> means() const {
        double squares = 0, lines = 0;
        for (size_t k = 0; k < squares_.size(); ++k) squares += squares_[k], lines += double(lines_[k]);
        if (!(squares > 0)) return {};
        std::vector<double> out(squares_.size(), unguided * std::sqrt(squares / lines));
        for (size_t k = 0; k < out.size(); ++k)
            if (lines_[k]) out[k] += std::sqrt(squares_[k] / double(lines_[k]));
        return out;
    }

   private:
    static constexpr int64_t most_tables = 1 << 12;
    static constexpr double unguided = 0.15;

    const ConnectedParts& parts_;
    int64_t tables_;
    std::vector<double> squares_;
    std::vector<int64_t> lines_;
};

// EdgeLines draws the lines past one edge or alpha edge at a time, in cells of constant pdf.
template <class T>
class EdgeLines {
   public:
    // `means` belong to the cells of `pooled`. If it is empty, all cells count equally.
    EdgeLines(const SceneView<T>& casters, const Topology& topology, const std::vector<AlphaEdge>& alpha_edges,
              const PooledLines& pooled, const std::vector<double>& means, const Mirrors& mirrors)
        : scene_(casters),
          topology_(topology),
          alpha_edges_(alpha_edges),
          pooled_(pooled),
          means_(means),
          mirrors_(mirrors) {}

    // Selects an edge, or an alpha edge, numbered after all edges. Returns its relative number of lines.
    double set(int64_t piece) {
        opposite_.clear(), stands_for_ = 1;
        if (piece < topology_.n_edges()) set_edge(piece);
        else set_alpha_edge(alpha_edges_[piece - topology_.n_edges()]);
        lune_ = {a_, b_, opposite_};
        across_ = means_.empty() ? 1 : int(std::clamp(std::ceil(lune_.width() / widest_cell), 1.0, most_cells_across));
        sum_.clear();
        const double measure = stands_for_ * lune_.measure();
        if (means_.empty() || lune_.empty()) return measure;
        double sum = 0;
        for (int j = 0; j < along; ++j)
            for (int k = 0; k < across_; ++k) {
                const Vec3 w = lune_.at(angle_at_middle(j), (k + 0.5) / across_);
                sum_.push_back(sum += means_[pooled_.cell(vertex_, w)]);
            }
        return measure * sum / double(sum_.size());
    }

    struct DrawnLine {
        double t;     // position on the edge
        Vec3 w;       // unit direction
        double area;  // ∫ dt dω over what the line stands for, were it the only one of this piece; 0: no line is drawn
    };
    // Maps numbers in [0, 1) to a line. `choice` selects the strategy.
    DrawnLine at(double along_edge, Vec2 u, double choice) {
        double t = along_edge;
        Vec2 there = u;
        if (!sum_.empty()) {
            const double s = along_edge * sum_.back();
            const int64_t k = std::min<int64_t>(std::upper_bound(sum_.begin(), sum_.end(), s) - sum_.begin(),
                                                int64_t(sum_.size()) - 1);
            t = std::clamp((s - before(k)) / (sum_[k] - before(k)), 0.0, 1.0);
            there = {(double(k / across_) + u.x) / along, (double(k % across_) + u.y) / across_};
        }
        Lune::Coordinates line{lune_.direction(there.x, there.y), there.x, there.y};
        if (mirrors_.empty() || lune_.empty()) return {t, line.w, stands_for_ * area(line)};
        mirrored_.set(mirrors_, (1 - t) * a_ + t * b_, lune_);
        const double share = mirrored_.share();
        if (choice < share) {
            const Vec3 w = mirrored_.draw(choice / share, u);
            line = dot(w, w) > 0 ? lune_.locate(w) : Lune::Coordinates();
            if (!line.is_there()) return {t, line.w, 0};
        }
        double pdf = (1 - share) / area(line);
        if (share > 0) pdf += share * mirrored_.pdf(line.w);
        return {t, line.w, stands_for_ / pdf};
    }
    int64_t cell(Vec3 w) const { return pooled_.cell(vertex_, w); }

   private:
    // Lines may pass in all directions where alpha masks may differ between its faces (TracedEdgeLines).
    void set_edge(int64_t edge) {
        const auto halves = topology_.half_edges(edge);
        const HalfEdge& h = halves[0];
        const bool any = alpha_masks_jump(scene_, topology_, edge);
        for (const HalfEdge& o : any ? halves.first(1) : halves)
            opposite_.push_back(corner(scene_, o.face, (o.corner + 2) % 3));
        vertex_ = vertex(scene_, h, h.first());
        a_ = corner(scene_, h.face, h.first()), b_ = corner(scene_, h.face, h.second());
    }
    // Uses the chord of the alpha edge, which lines pass in all directions except in the face's plane.
    void set_alpha_edge(const AlphaEdge& alpha_edge) {
        const Vec3 v[3] = {corner(scene_, alpha_edge.face, 0), corner(scene_, alpha_edge.face, 1),
                           corner(scene_, alpha_edge.face, 2)};
        const auto at = [&](Barycentrics b) { return b[0] * v[0] + b[1] * v[1] + b[2] * v[2]; };
        vertex_ = scene_.faces[3 * int64_t(alpha_edge.face)], stands_for_ = alpha_edge.share;
        a_ = at(alpha_edge.begin), b_ = at(alpha_edge.end);
        const auto apart = [&](Vec3 p) { return length(cross(p - a_, b_ - a_)); };
        opposite_.push_back(*std::max_element(v, v + 3, [&](Vec3 p, Vec3 q) { return apart(p) < apart(q); }));
    }

    static constexpr int along = 8;
    static constexpr double widest_cell = M_PI / 8, most_cells_across = 8;  // azimuths of a cell, radians and number

    static double angle_at_middle(int j) {
        static const std::vector<double> angles = [] {
            std::vector<double> out;
            for (int k = 0; k < along; ++k) out.push_back(Lune::polar_angle((k + 0.5) / along));
            return out;
        }();
        return angles[j];
    }
    double before(int64_t k) const { return k ? sum_[k - 1] : 0; }
    // Returns the reciprocal pdf of the lines that cells draw.
    double area(const Lune::Coordinates& line) const {
        const double all = lune_.weight(line.w);
        if (sum_.empty()) return all;
        const int j = std::min(int(line.u * along), along - 1), i = std::min(int(line.v * across_), across_ - 1);
        const int64_t k = int64_t(j) * across_ + i;
        return all * sum_.back() / ((sum_[k] - before(k)) * double(sum_.size()));
    }

    const SceneView<T>& scene_;
    const Topology& topology_;
    const std::vector<AlphaEdge>& alpha_edges_;
    const PooledLines& pooled_;
    const std::vector<double>& means_;
    const Mirrors& mirrors_;
    std::vector<Vec3> opposite_;
    int32_t vertex_ = 0;
    double stands_for_ = 1;
    Vec3 a_, b_;
    Lune lune_;
    SpecularLines mirrored_;
    int across_ = 1;
    std::vector<double> sum_;  // running sum of the cells' means
};

}  // namespace edgegrad
