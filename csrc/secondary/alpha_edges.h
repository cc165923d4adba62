// This file finds the alpha edges of alpha-tested faces and cuts them at the borders of texel cells.
//
// Between four texels a bilinear α is f + x f_x + y f_y + x y f_xy. The alpha edge F = α − cutoff = 0 is therefore a
// hyperbola whose axes are the texture's. A branch is monotonous and convex, so a line across its chord meets it once,
// and before the other branch. The position t along the chord therefore parametrises the branch. Where the filter is
// nearest, alpha edges are texel edges.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <vector>

#include "boundary/discontinuity_finder.h"
#include "core/parallel.h"
#include "core/sampler.h"
#include "rays/alpha_mask.h"

namespace edgegrad {

// An AlphaEdge is a piece of an alpha edge within one texel cell and on one face.
struct AlphaEdge {
    int32_t face;
    // border is 0 on a bilinear α. Between nearest texels it is the coordinate that changes across the edge, 1 or 2.
    // Its sign tells the side on which the face is opaque.
    int border;
    double i, j;  // position of the cell, in texels
    Barycentrics begin, end;
    double share;  // number of pieces that this one stands for
};

// An AlphaEdgePoint is a point of an alpha edge. In barycentrics, with κ: dp/dt = κ (−∂F/∂v, ∂F/∂u).
struct AlphaEdgePoint {
    Barycentrics b;
    Barycentrics slope;  // ∂F/∂b
    Vec2 by_uv;          // ∂F/∂uv
    double kappa;
    Footprint alpha;  // texels and weights of F, where it is bilinear
};

// FaceCells maps a face to the cells of its alpha texture. The corners of cells are the centres of texels, or, where
// the filter is nearest, the corners of texels.
template <class T>
class FaceCells {
   public:
    FaceCells(const SceneView<T>& scene, int32_t face)
        : texture(alpha_of(scene, face)),
          cutoff(cutoff_of(scene, face)),
          linear(texture.sampler.filter != TextureFilter::nearest) {
        const Vec2 origin = linear ? Vec2{0.5, 0.5} : Vec2{};
        for (int i = 0; i < 3; ++i) {
            const double* uv = scene.uvs + 2 * int64_t(scene.uv_corners[3 * int64_t(face) + i]);
            corner[i] = texture.place({uv[0], uv[1]}) - origin;
        }
        side[0] = corner[1] - corner[0], side[1] = corner[2] - corner[0], area = wedge(side[0], side[1]);
    }

    Vec2 place(Barycentrics b) const { return corner[0] + b.u * side[0] + b.v * side[1]; }
    Barycentrics at(Vec2 q) const {
        const Vec2 d = q - corner[0];
        return {wedge(d, side[1]) / area, wedge(side[0], d) / area};
    }
    double alpha(double i, double j) const { return double(texture.texels[texel_at(texture, i, j).texel[0]]) - cutoff; }

    const Texture<T> texture;
    const double cutoff;
    const bool linear;
    Vec2 corner[3], side[2];
    double area;  // twice the signed area, texels²
};

// AlphaCell holds F of a bilinear α in the cell whose first corner is (i, j).
struct AlphaCell {
    double i, j, f[4];

    bool there(int k) const { return f[k] >= 0; }
    bool has_alpha_edge() const { return there(0) != there(1) || there(0) != there(2) || there(0) != there(3); }
    double both() const { return f[0] - f[1] - f[2] + f[3]; }
    double value(Vec2 q) const {
        const double x = q.x - i, y = q.y - j;
        return f[0] + x * (f[1] - f[0]) + y * (f[2] - f[0]) + x * y * both();
    }
    Vec2 gradient(Vec2 q) const { return {f[1] - f[0] + (q.y - j) * both(), f[2] - f[0] + (q.x - i) * both()}; }
    // Returns the nearest point of the alpha edge across a chord through q.
    Vec2 on_alpha_edge(Vec2 q, Vec2 chord) const {
        const Vec2 across{-chord.y, chord.x}, g = gradient(q);
        const double c0 = value(q), c1 = g.x * across.x + g.y * across.y, c2 = across.x * across.y * both();
        const double root = std::sqrt(std::max(0.0, c1 * c1 - 4 * c2 * c0)), d = -0.5 * (c1 + (c1 > 0 ? root : -root));
        return d != 0 ? q + (c0 / d) * across : q;
    }
};

template <class T>
class AlphaEdgeFinder {
   public:
    explicit AlphaEdgeFinder(const SceneView<T>& scene) : scene_(scene) {}

    // Returns all pieces. If cells or pieces are too many, the seed draws a subset that stands for all.
    std::vector<AlphaEdge> find(uint64_t seed, ThreadTeam& team) const {
        std::vector<AlphaEdge> found;
        if (!scene_.alpha_masks.face) return found;
        double cells = 0;
        for (int64_t f = 0; f < scene_.n_faces; ++f)
            if (scene_.alpha_masks.on(f)) cells += cells_of({scene_, int32_t(f)});
        const double every = std::max(1.0, std::ceil(cells / most_cells));
        const auto parts = team.map_blocks(scene_.n_faces, [&](int64_t first, int64_t last) {
            std::vector<AlphaEdge> part;
            for (int64_t f = first; f < last; ++f)
                if (scene_.alpha_masks.on(f)) add(int32_t(f), every, to_unit(hash(seed, uint64_t(f))), part);
            return part;
        });
        for (const auto& part : parts) found.insert(found.end(), part.begin(), part.end());
        const int64_t n = int64_t(found.size());
        if (n <= most_alpha_edges) return found;
        std::vector<AlphaEdge> some;
        const double spacing = double(n) / double(most_alpha_edges), shift = to_unit(mix(seed));
        for (int64_t k = 0; k < most_alpha_edges; ++k) {
            some.push_back(found[std::min(int64_t((double(k) + shift) * spacing), n - 1)]);
            some.back().share *= spacing;
        }
        return some;
    }

    // Sets `out` at the fraction t along the chord. Returns false where rounding leaves no direction.
    bool place(const AlphaEdge& alpha_edge, double t, AlphaEdgePoint& out) const {
        const FaceCells<T> cells(scene_, alpha_edge.face);
        const Vec2 a = cells.place(alpha_edge.begin), b = cells.place(alpha_edge.end), chord = b - a;
        Vec2 q = a + t * chord, gradient;
        if (alpha_edge.border == 0) {
            const double i = alpha_edge.i, j = alpha_edge.j;
            const AlphaCell cell{
                i, j, {cells.alpha(i, j), cells.alpha(i + 1, j), cells.alpha(i, j + 1), cells.alpha(i + 1, j + 1)}};
            q = cell.on_alpha_edge(q, chord), gradient = cell.gradient(q);
            out.alpha = footprint_at(cells.texture, cell.i, cell.j, q.x - cell.i, q.y - cell.j);
        } else gradient = gradient_across(alpha_edge.border);
        out.b = cells.at(q);
        out.by_uv = {gradient.x * double(cells.texture.width), -gradient.y * double(cells.texture.height)};
        out.slope = {dot(gradient, cells.side[0]), dot(gradient, cells.side[1])};
        // In cells dp/dt = κ area (−F_y, F_x). Its component along the chord equals the chord.
        out.kappa = dot(chord, chord) / (wedge(gradient, chord) * cells.area);
        return std::isfinite(out.kappa);
    }

   private:
    static constexpr double most_cells = 0x1p22;
    static constexpr int64_t most_alpha_edges = 1 << 16;

    static double dot(Vec2 a, Vec2 b) { return a.x * b.x + a.y * b.y; }
    static Vec2 gradient_across(int border) {
        const double sign = border > 0 ? 1 : -1;
        return std::abs(border) == 1 ? Vec2{sign, 0} : Vec2{0, sign};
    }
    // Estimates the number of cells that a face covers.
    static double cells_of(const FaceCells<T>& cells) {
        const double n = 0.5 * std::fabs(cells.area) + 2 * (length(cells.side[0]) + length(cells.side[1])) + 1;
        return std::isfinite(n) ? n : 0;
    }

    // Adds the pieces in every `every`-th row of cells, starting at a random one.
    void add(int32_t face, double every, double random, std::vector<AlphaEdge>& out) const {
        const FaceCells<T> cells(scene_, face);
        if (!(std::fabs(cells.area) > 0) || !std::isfinite(cells.area)) return;
        const Vec2* p = cells.corner;
        const double top = std::floor(std::min({p[0].y, p[1].y, p[2].y})), bottom = std::max({p[0].y, p[1].y, p[2].y});
        for (double j = top + std::floor(random * every); j <= bottom; j += every) {
            // The interval [low, high] is what the face covers of this row.
            double low = std::numeric_limits<double>::infinity(), high = -low;
            const auto take = [&](double x) { low = std::min(low, x), high = std::max(high, x); };
            for (int k = 0; k < 3; ++k) {
                const Vec2 a = p[k], b = p[(k + 1) % 3];
                if (a.y >= j && a.y <= j + 1) take(a.x);
                for (const double y : {j, j + 1})
                    if ((a.y < y) != (b.y < y)) take(a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x));
            }
            if (!(low <= high)) continue;
            double i = std::floor(low);
            if (!cells.linear) {
                for (; i <= high; ++i) add_texel(face, cells, i, j, every, out);
                continue;
            }
            const auto column = [&](double i) { return Vec2{cells.alpha(i, j), cells.alpha(i, j + 1)}; };
            for (Vec2 left = column(i); i <= high; ++i) {
                const Vec2 right = column(i + 1);
                add_cell(face, cells, {i, j, {left.x, right.x, left.y, right.y}}, every, out);
                left = right;
            }
        }
    }

    void add_cell(int32_t face, const FaceCells<T>& cells, const AlphaCell& c, double every,
                  std::vector<AlphaEdge>& out) const {
        if (!c.has_alpha_edge()) return;
        // These are the points at which the alpha edge meets the sides of the cell. One of two branches lies on either
        // side of the cell's middle, across.
        const auto between = [&](int k, int m) { return c.f[k] / (c.f[k] - c.f[m]); };
        Vec2 left[2], right[2];
        int n_left = 0, n_right = 0;
        const bool above = c.there(0) != c.there(1), below = c.there(2) != c.there(3);
        const double x_above = above ? between(0, 1) : 0, x_below = below ? between(2, 3) : 0;
        const bool two = above && below && c.there(0) != c.there(2);
        const auto add_point = [&](bool to_right, double x, double y) {
            Vec2* to = to_right ? right : left;
            to[(to_right ? n_right : n_left)++] = {c.i + x, c.j + y};
        };
        if (c.there(0) != c.there(2)) add_point(false, 0, between(0, 2));
        if (c.there(1) != c.there(3)) add_point(two, 1, between(1, 3));
        if (above) add_point(two && x_above > x_below, x_above, 0);
        if (below) add_point(two && !(x_above > x_below), x_below, 1);
        if (n_left == 2) clip(face, cells, &c, 0, left, every, out);
        if (n_right == 2) clip(face, cells, &c, 0, right, every, out);
    }

    void add_texel(int32_t face, const FaceCells<T>& cells, double i, double j, double every,
                   std::vector<AlphaEdge>& out) const {
        const bool here = cells.alpha(i, j) >= 0;
        const Vec2 across[2] = {{i, j}, {i, j + 1}}, down[2] = {{i, j}, {i + 1, j}};
        if ((cells.alpha(i - 1, j) >= 0) != here) clip(face, cells, nullptr, here ? 1 : -1, across, every, out);
        if ((cells.alpha(i, j - 1) >= 0) != here) clip(face, cells, nullptr, here ? 2 : -2, down, every, out);
    }

    // Adds the parts of a piece that lie on the face.
    void clip(int32_t face, const FaceCells<T>& cells, const AlphaCell* cell, int border, const Vec2 (&end)[2],
              double every, std::vector<AlphaEdge>& out) const {
        const Vec2 chord = end[1] - end[0];
        const double squared = dot(chord, chord);
        if (!(squared > 0)) return;
        // Cuts are where the piece meets the sides of the face.
        double part[8] = {0, 1};  // ascending fractions of the chord
        int n = 2;
        const auto cut = [&](double t) {
            if (!(t > 0 && t < 1)) return;
            int k = n++;
            for (; part[k - 1] > t; --k) part[k] = part[k - 1];
            part[k] = t;
        };
        for (int k = 0; k < 3; ++k) {
            const Vec2 a = cells.corner[k], along = cells.corner[(k + 1) % 3] - a;
            if (!cell) {
                const double from = wedge(along, end[0] - a), to = wedge(along, end[1] - a);
                cut(from / (from - to));
            } else {
                const Vec2 g = cell->gradient(a);
                each_sign_change(cell->value(a), dot(g, along), along.x * along.y * cell->both(), 0,
                                 [&](double s) { cut(dot(a + s * along - end[0], chord) / squared); });
            }
        }
        const auto at = [&](double t) {
            const Vec2 q = end[0] + t * chord;
            return cell ? cell->on_alpha_edge(q, chord) : q;
        };
        for (int k = 1; k < n; ++k) {
            if (!(part[k] > part[k - 1])) continue;
            const Vec2 middle = at(0.5 * (part[k - 1] + part[k]));
            if (!lies_on(cells, middle, cell ? cell->gradient(middle) : Vec2{})) continue;
            out.push_back({face, border, cell ? cell->i : 0, cell ? cell->j : 0, cells.at(at(part[k - 1])),
                           cells.at(at(part[k])), every});
        }
    }

    // Returns whether a point of the alpha edge lies on the face. An alpha edge along a side belongs to the face that
    // is alpha-tested there. Between nearest texels that edge itself casts the shadow.
    static bool lies_on(const FaceCells<T>& cells, Vec2 q, Vec2 gradient) {
        const double turn = cells.area > 0 ? 1 : -1;
        for (int k = 0; k < 3; ++k) {
            const Vec2 a = cells.corner[k], along = cells.corner[(k + 1) % 3] - a;
            const double within = turn * wedge(along, q - a) / length(along);
            const double rounding = 1e-10 * (1 + std::fabs(q.x) + std::fabs(q.y));
            if (within < -rounding) return false;
            if (within <= rounding && turn * wedge(along, gradient) >= 0) return false;
        }
        return true;
    }

    const SceneView<T>& scene_;
};

}  // namespace edgegrad
