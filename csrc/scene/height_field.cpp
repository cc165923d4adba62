#include "scene/height_field.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "core/math.h"

namespace edgegrad {

namespace {

constexpr int64_t most_leaves = 64, least_leaves = 8;  // bounds of the leaves of a prism
constexpr float slab = 0.25;                           // It extends beyond its faces this far, relative to its base.
// Its faces cover at least this part of its base, or it would reach far beyond them.
constexpr double least_part = 0.1;

constexpr int lanes = CornerGroup::size;
constexpr float infinity = std::numeric_limits<float>::infinity();

// Bounds the relative error of a coordinate: twice four products and sums of floats of half a spacing each.
constexpr float rounding = 0x1p-20f;

struct Interval {
    float low = infinity, high = -infinity;
};

// Has coordinates u, v over its base and w along it, and holds their intervals.
struct Prism {
    float axis[3][3];  // The first index is the coordinate.
    Interval own[3];
    float point[2];  // The line through this point of the base must meet one face.
};

// Holds the three coordinates of the corners of eight faces.
struct PrismCoordinates {
    float x[3][3][lanes];  // Indices are coordinate and corner.
};

inline void place(const CornerGroup& g, const float (&axis)[3][3], const float (&offset)[3], PrismCoordinates& out) {
    for (int k = 0; k < 3; ++k)
        for (int c = 0; c < 3; ++c) {
            EDGEGRAD_ROLLED
            for (int i = 0; i < lanes; ++i)
                out.x[k][c][i] =
                    axis[k][0] * g.p[c][0][i] + axis[k][1] * g.p[c][1][i] + axis[k][2] * g.p[c][2][i] + offset[k];
        }
}

inline float lesser(float a, float b) { return a < b ? a : b; }
inline float greater(float a, float b) { return a > b ? a : b; }

// Adds the normals of eight faces, not normalised.
EDGEGRAD_VECTORIZED void add_normals(const CornerGroup& g, float (&sum)[3]) {
    float n[3][lanes];
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const float ax = g.p[1][0][i] - g.p[0][0][i], ay = g.p[1][1][i] - g.p[0][1][i],
                    az = g.p[1][2][i] - g.p[0][2][i];
        const float bx = g.p[2][0][i] - g.p[0][0][i], by = g.p[2][1][i] - g.p[0][1][i],
                    bz = g.p[2][2][i] - g.p[0][2][i];
        n[0][i] = ay * bz - az * by, n[1][i] = az * bx - ax * bz, n[2][i] = ax * by - ay * bx;
    }
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < lanes; ++i) sum[k] += n[k][i];
}

EDGEGRAD_VECTORIZED void widen(const CornerGroup& g, const float (&axis)[3][3], const float (&offset)[3],
                               Interval (&own)[3]) {
    PrismCoordinates p;
    place(g, axis, offset, p);
    for (int k = 0; k < 3; ++k) {
        float low = own[k].low, high = own[k].high;
        for (int c = 0; c < 3; ++c)
            for (int i = 0; i < lanes; ++i) low = std::min(low, p.x[k][c][i]), high = std::max(high, p.x[k][c][i]);
        own[k] = {low, high};
    }
}

// Holds masks of eight faces.
struct Touching {
    unsigned any = 0;   // These touch the prism.
    unsigned fail = 0;  // These touch it, but do not face along it, or reach its top or bottom.
    unsigned met = 0;   // These touch it, and the line may meet them.
};

EDGEGRAD_VECTORIZED Touching touching_lanes(const CornerGroup& g, const Prism& prism, const float (&offset)[3],
                                            const float e) {
    PrismCoordinates p;
    place(g, prism.axis, offset, p);
    float low[3][lanes], high[3][lanes];
    for (int k = 0; k < 3; ++k) {
        const auto& x = p.x[k];
        EDGEGRAD_ROLLED
        for (int i = 0; i < lanes; ++i) {
            const float a = x[0][i], b = x[1][i], c = x[2][i];
            low[k][i] = lesser(lesser(a, b), c), high[k][i] = greater(greater(a, b), c);
        }
    }
    const float pu = prism.point[0], pv = prism.point[1];
    float whole[lanes], least[lanes], doubt[lanes], far[lanes];
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const float u0 = p.x[0][0][i] - pu, u1 = p.x[0][1][i] - pu, u2 = p.x[0][2][i] - pu;
        const float v0 = p.x[1][0][i] - pv, v1 = p.x[1][1][i] - pv, v2 = p.x[1][2][i] - pv;
        // They are twice the areas over the base of the face, and of the triangles of its sides and the point.
        whole[i] = (u1 - u0) * (v2 - v0) - (v1 - v0) * (u2 - u0);
        least[i] = lesser(lesser(u0 * v1 - v0 * u1, u1 * v2 - v1 * u2), u2 * v0 - v2 * u0);
        // The areas are uncertain by this where each coordinate may be off by e.
        doubt[i] = 8 * e * ((high[0][i] - low[0][i]) + (high[1][i] - low[1][i]) + 2 * e);
        far[i] = doubt[i] + 8 * e * (greater(u0, -u0) + greater(v0, -v0));
    }
    const Interval u{prism.own[0].low - e, prism.own[0].high + e}, v{prism.own[1].low - e, prism.own[1].high + e},
        w{prism.own[2].low, prism.own[2].high};
    const float w_low = w.low - e, w_high = w.high + e, above = w.low + e, below = w.high - e;
    int32_t bits[lanes];
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        const int32_t touches = (low[0][i] <= u.high) & (high[0][i] >= u.low) & (low[1][i] <= v.high) &
                                (high[1][i] >= v.low) & (low[2][i] <= w_high) & (high[2][i] >= w_low) &
                                (g.vertex[0][i] >= 0);
        const int32_t fails = (whole[i] <= doubt[i]) | (low[2][i] <= above) | (high[2][i] >= below);
        const int32_t meets = least[i] > -far[i];
        bits[i] = (touches | (touches & fails) << 8 | (touches & meets) << 16) << i;
    }
    int32_t all = 0;
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) all |= bits[i];
    return {.any = unsigned(all) & 0xff, .fail = unsigned(all) >> 8 & 0xff, .met = unsigned(all) >> 16};
}

// Tests whether the surface is a height field in the prism around the leaves first … last − 1.
class PrismTest {
   public:
    PrismTest(const FaceTree& tree, const std::vector<uint8_t>& closed) : tree_(tree), closed_(closed) {}

    bool holds(int64_t first, int64_t last, int32_t surface) {
        if (!place_axes(first, last)) return false;
        for (Interval& i : prism_.own) i = {};
        for (int64_t leaf = first; leaf < last; ++leaf) {
            const CornerGroup& g = tree_.corners(leaf);
            float offset[3];
            place_origin(g, offset);
            widen(g, prism_.axis, offset, prism_.own);
        }
        Interval(&own)[3] = prism_.own;
        const float u = own[0].high - own[0].low, v = own[1].high - own[1].low;
        if (area_ < least_part * u * double(v)) return false;
        own[2].low -= slab * std::max(u, v), own[2].high += slab * std::max(u, v);
        if (!(own[2].high - own[2].low < infinity)) return false;
        place_line(first, last);

        bool holds = true;
        int met = 0;
        const auto touch = [&](int64_t leaf) {
            const CornerGroup& g = tree_.corners(leaf);
            float offset[3];
            place_origin(g, offset);
            const Touching t = touching_lanes(g, prism_, offset, error(g, offset));
            holds = !(t.fail | (t.any & ~unsigned(closed_[leaf])));
            met += std::popcount(t.met);
        };
        // Its own leaves come first, because most failures occur there.
        for (int64_t leaf = first; leaf < last && holds; ++leaf) touch(leaf);
        if (!holds || met != 1) return false;
        tree_.each_leaf(box(), 0, -1, [&](int64_t leaf) {
            const int32_t of = tree_.surface(leaf);
            if ((leaf < first || leaf >= last) && (of < 0 || of == surface)) touch(leaf);
            return holds;
        });
        return holds && met == 1;
    }

   private:
    // Sets w along the mean normal, and u and v across. Any three directions are valid; these see the surface widest.
    bool place_axes(int64_t first, int64_t last) {
        origin_ = tree_.corners(first).origin;
        float sum[3] = {0, 0, 0};
        for (int64_t leaf = first; leaf < last; ++leaf) add_normals(tree_.corners(leaf), sum);
        const Vec3 normal{sum[0], sum[1], sum[2]};
        const double size = length(normal);
        if (!(size > 0) || !(size < infinity)) return false;
        const Vec3 w = (1 / size) * normal;
        const double x = std::fabs(w.x), y = std::fabs(w.y), z = std::fabs(w.z);
        const Vec3 u = x <= y && x <= z ? Vec3{1, 0, 0} - w.x * w
                       : y <= z         ? Vec3{0, 1, 0} - w.y * w
                                        : Vec3{0, 0, 1} - w.z * w;
        area_ = 0.5 * size;
        axis_[0] = (1 / length(u)) * u, axis_[1] = cross(w, axis_[0]), axis_[2] = w;
        for (int k = 0; k < 3; ++k) {
            prism_.axis[k][0] = float(axis_[k].x), prism_.axis[k][1] = float(axis_[k].y),
            prism_.axis[k][2] = float(axis_[k].z);
            axis_[k] = {prism_.axis[k][0], prism_.axis[k][1], prism_.axis[k][2]};
        }
        return true;
    }

    void place_origin(const CornerGroup& g, float (&offset)[3]) const {
        for (int k = 0; k < 3; ++k) offset[k] = float(dot(axis_[k], g.origin - origin_));
    }

    // Bounds the error of a coordinate, and of an end of the prism.
    float error(const CornerGroup& g, const float (&offset)[3]) const {
        float size = 2 * g.reach;
        for (int k = 0; k < 3; ++k)
            size = std::max({size, 2 * g.reach + std::fabs(offset[k]), std::fabs(prism_.own[k].low),
                             std::fabs(prism_.own[k].high)});
        return rounding * size + std::numeric_limits<float>::min();
    }

    // Places the line through the centre of a face in the middle.
    void place_line(int64_t first, int64_t last) {
        const CornerGroup& g = tree_.corners((first + last) / 2);
        float offset[3];
        place_origin(g, offset);
        for (int k = 0; k < 2; ++k) {
            double mean = 0;
            for (int c = 0; c < 3; ++c) mean += dot(axis_[k], Vec3{g.p[c][0][0], g.p[c][1][0], g.p[c][2][0]}) / 3;
            prism_.point[k] = float(mean + offset[k]);
        }
    }

    // Returns the prism as an oriented box for the tree, whose boxes are rounded to floats in the world.
    OrientedBox box() const {
        OrientedBox box;
        Vec3 middle = origin_;
        for (int k = 0; k < 3; ++k) {
            const Interval& i = prism_.own[k];
            // The axes are orthonormal up to their rounding.
            middle += (0.5 * (double(i.low) + i.high)) * axis_[k];
            box.half[k] = (i.high - i.low) * 0.5f * (1 + 0x1p-16f);
        }
        const double at[3] = {middle.x, middle.y, middle.z};
        double most = 0;
        for (int k = 0; k < 3; ++k) {
            box.middle[k] = float(at[k]), most = std::max(most, std::fabs(at[k]));
            std::copy_n(prism_.axis[k], 3, box.axis[k]);
        }
        const double own =
            std::max({std::fabs(prism_.own[0].low), std::fabs(prism_.own[0].high), std::fabs(prism_.own[1].low),
                      std::fabs(prism_.own[1].high), std::fabs(prism_.own[2].low), std::fabs(prism_.own[2].high)});
        for (float& half : box.half) half += float(0x1p-20 * (most + 4 * own));
        return box;
    }

    const FaceTree& tree_;
    const std::vector<uint8_t>& closed_;
    Vec3 origin_, axis_[3];
    double area_;  // area of its own faces over the base
    Prism prism_;
};

}  // namespace

class HeightFields::Search {
   public:
    Search(const FaceTree& tree, const std::vector<uint8_t>& closed, std::vector<Crossed>& by)
        : tree_(tree), test_(tree, closed), by_(by) {}

    // Marks the leaves of a node, or those of its parts for which the test holds.
    void mark(int64_t first, int64_t span, bool holds = false) {
        const int64_t last = std::min(int64_t(by_.size()), first + span);
        const int32_t surface = tree_.surface(first, span);
        if (!holds) holds = surface >= 0 && test_.holds(first, last, surface);
        const bool alone = holds && !meets_other(first, last, surface);
        if (holds) std::fill(by_.begin() + first, by_.begin() + last, alone ? Crossed::by_none : Crossed::by_others);
        if (alone || span == least_leaves) return;
        for (const int64_t part = span / BoxGroup::size; first < last; first += part) mark(first, part, holds);
    }

   private:
    // Returns whether the leaves' box overlaps a leaf with faces of another surface.
    bool meets_other(int64_t first, int64_t last, int32_t surface) const {
        FaceBox box = tree_.leaf(first).bounds();
        for (int64_t leaf = first + 1; leaf < last; ++leaf) box = box.with(tree_.leaf(leaf).bounds());
        bool found = false;
        tree_.each_leaf(box, 0, surface, [&](int64_t) { return !(found = true); });
        return found;
    }

    const FaceTree& tree_;
    PrismTest test_;
    std::vector<Crossed>& by_;
};

HeightFields::HeightFields(const FaceTree& tree, const Topology& topology, ThreadTeam& team)
    : tree_(&tree), by_(tree.n_leaves(), Crossed::by_any) {
    const int64_t leaves = tree.n_leaves(), nodes = (leaves + most_leaves - 1) / most_leaves;
    std::vector<uint8_t> closed(leaves, 0);  // Each face has a bit.
    team.parallel_for_blocks(leaves, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t leaf = first; leaf < last; ++leaf)
            for (int lane = 0; lane < FaceTree::leaf_size; ++lane)
                if (const int32_t f = tree.face(leaf, lane); f >= 0 && topology.has_all_neighbours(f))
                    closed[leaf] |= 1 << lane;
    });
    team.parallel_for_with_state(
        nodes, [&] { return std::make_unique<Search>(tree, closed, by_); },
        [&](Search& search, int64_t node) { search.mark(node * most_leaves, most_leaves); });
}

}  // namespace edgegrad
