#include "scene/topology.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <functional>
#include <numeric>

#include "core/sampler.h"

namespace edgegrad {

namespace {

// A long loop checks for interruption after this many items.
constexpr int64_t check_every = 1 << 14;

// Stores the positions found so far, one vertex each, in a hash table of cells.
//
// Two copies that went through the same rotation and translation differ by a few roundings at most. All within a reach
// of 8 spacings of the largest coordinate is therefore one position. No two positions of one spacing lie within each
// other's reach, so a cell of some reaches holds few of them. Finding one takes a constant time however many vertices
// coincide. Spacings and magnitudes have their own cells.
class VertexGrid {
   public:
    explicit VertexGrid(size_t vertices) : head_(std::bit_ceil(std::max<size_t>(64, vertices)), -1) {}

    // Returns the nearest position of this spacing within reach of the vertex, −1: none.
    int32_t nearest(const double* verts, int32_t vertex, double spacing) const {
        const double *p = verts + 3 * int64_t(vertex), m = magnitude(p), reach = 8 * spacing * m;
        int32_t found = -1;
        double least = reach;
        const int low = binade(m - reach), high = binade(m + reach);
        for (int e = low; e <= high; ++e) {
            const double cell = cell_of(e, spacing);
            int64_t begin[3], end[3];
            for (int i = 0; i < 3; ++i) begin[i] = index(p[i] - reach, cell), end[i] = index(p[i] + reach, cell);
            for (int64_t x = begin[0]; x <= end[0]; ++x)
                for (int64_t y = begin[1]; y <= end[1]; ++y)
                    for (int64_t z = begin[2]; z <= end[2]; ++z) {
                        const uint64_t key = key_of(e, spacing, x, y, z);
                        for (int32_t i = head_[key & (head_.size() - 1)]; i >= 0; i = stored_[i].next) {
                            if (stored_[i].key != key) continue;
                            const double* o = verts + 3 * int64_t(stored_[i].vertex);
                            const double apart =
                                std::max({std::fabs(p[0] - o[0]), std::fabs(p[1] - o[1]), std::fabs(p[2] - o[2])});
                            if (apart < least || (apart == least && (found < 0 || stored_[i].vertex < found)))
                                least = apart, found = stored_[i].vertex;
                        }
                    }
        }
        return found;
    }

    void add(const double* verts, int32_t vertex, double spacing) {
        const double* p = verts + 3 * int64_t(vertex);
        const int e = binade(magnitude(p));
        const double cell = cell_of(e, spacing);
        const uint64_t key = key_of(e, spacing, index(p[0], cell), index(p[1], cell), index(p[2], cell));
        int32_t& head = head_[key & (head_.size() - 1)];
        stored_.push_back({key, vertex, head});
        head = int32_t(stored_.size()) - 1;
    }

   private:
    struct StoredVertex {
        uint64_t key;
        int32_t vertex, next;
    };

    static double magnitude(const double* p) { return std::max({std::fabs(p[0]), std::fabs(p[1]), std::fabs(p[2])}); }
    // Magnitudes far below the least float count as one, so that cells do not vanish.
    static int binade(double magnitude) { return magnitude > 0x1p-900 ? std::ilogb(magnitude) : -900; }
    // Returns four to eight reaches of the binade's magnitudes, so that few cells lie within reach of a point.
    static double cell_of(int binade, double spacing) { return std::ldexp(64 * std::max(spacing, 0x1p-52), binade); }
    static int64_t index(double x, double cell) { return int64_t(std::floor(x / cell)); }
    static uint64_t key_of(int binade, double spacing, int64_t x, int64_t y, int64_t z) {
        return hash(hash(uint64_t(binade), std::bit_cast<uint64_t>(spacing), uint64_t(x)), uint64_t(y), uint64_t(z));
    }

    std::vector<int32_t> head_;
    std::vector<StoredVertex> stored_;
};

// Joins the sets 0 … n − 1 one by one, and names each after its least member (Galler and Fischer 1964).
class DisjointSets {
   public:
    explicit DisjointSets(int64_t n) : up_(n) { std::iota(up_.begin(), up_.end(), 0); }

    int32_t first(int32_t i) {
        while (up_[i] != i) i = up_[i] = up_[up_[i]];
        return i;
    }
    void join(int32_t i, int32_t k) {
        const int32_t a = first(i), b = first(k);
        up_[std::max(a, b)] = std::min(a, b);
    }

   private:
    std::vector<int32_t> up_;
};

}  // namespace

ConnectedParts::ConnectedParts(const int32_t* faces, int64_t n_faces, int64_t n_verts, ThreadTeam& team)
    : part_(n_verts) {
    DisjointSets sets(n_verts);
    for (int64_t i = 0; i < 3 * n_faces; ++i) {
        if (i % check_every == 0) team.check();
        sets.join(faces[i], faces[i - i % 3]);
    }
    for (int64_t v = 0; v < n_verts; ++v) {
        const int32_t first = sets.first(int32_t(v));
        part_[v] = first == v ? size_++ : part_[first];
    }
    of_block_.resize(ThreadTeam::blocks(n_faces));
    team.parallel_for_blocks(n_faces, [&](int64_t k, int64_t first, int64_t last) {
        int32_t part = part_[faces[3 * first]];
        for (int64_t f = first; f < last && part >= 0; ++f)
            if (part_[faces[3 * f]] != part) part = -1;
        of_block_[k] = part;
    });
}

Topology::Topology(const int32_t* faces, int64_t n_faces, int64_t n_verts, ThreadTeam& team)
    : faces_(faces), n_faces_(n_faces), n_verts_(n_verts) {
    build(team);
    std::vector<bool> on_border(n_verts, false);
    for (int64_t e = 0; e < n_edges(); ++e) {
        if (e % check_every == 0) team.check();
        const auto edge = half_edges(e);
        if (edge.size() != 1) continue;
        const int32_t* f = faces_ + 3 * int64_t(edge[0].face);
        on_border[f[edge[0].corner]] = on_border[f[(edge[0].corner + 1) % 3]] = true;
    }
    for (int64_t v = 0; v < n_verts; ++v)
        if (on_border[v]) candidates_.push_back(int32_t(v));
}

void Topology::weld(const double* verts, const Spacing& spacing, ThreadTeam& team) {
    if (candidates_.empty()) return;
    // Copies may lie between others of a coarser spacing, never the reverse, so coarse ones come first.
    std::vector<double> spacings = spacing.value;
    std::sort(spacings.begin(), spacings.end(), std::greater<>());
    spacings.erase(std::unique(spacings.begin(), spacings.end()), spacings.end());

    std::vector<int32_t> welded(n_verts_);
    std::iota(welded.begin(), welded.end(), 0);
    bool any = false;
    VertexGrid grid(candidates_.size());
    for (size_t k = 0; k < spacings.size(); ++k)
        for (size_t i = 0; i < candidates_.size(); ++i) {
            if (i % check_every == 0) team.check();
            const int32_t v = candidates_[i];
            if (spacing.of(v) != spacings[k]) continue;
            int32_t found = -1;
            for (size_t coarser = 0; coarser <= k && found < 0; ++coarser)
                found = grid.nearest(verts, v, spacings[coarser]);
            if (found >= 0) welded[v] = found, any = true;
            else grid.add(verts, v, spacings[k]);
        }
    if (!any) welded.clear();
    if (welded == welded_) return;
    welded_ = std::move(welded);
    build(team);
}

void Topology::build(ThreadTeam& team) {
    // Buckets of half-edges by lower vertex, each sorted by the upper one, take time linear in the number of faces.
    struct BucketedHalfEdge {
        int32_t upper;
        HalfEdge half_edge;
    };
    // Ranking vertices in the order of their faces keeps consecutive edges close to each other. A subdivision appends
    // its new vertices to all others.
    std::vector<int32_t> rank(n_verts_, -1);
    const auto at = [&](int64_t face, int corner) {
        const int32_t v = faces_[3 * face + corner % 3];
        return rank[welded_.empty() ? v : welded_[v]];
    };
    int32_t next = 0;
    for (int64_t i = 0; i < 3 * n_faces_; ++i) {
        if (i % check_every == 0) team.check();
        const int32_t v = welded_.empty() ? faces_[i] : welded_[faces_[i]];
        if (rank[v] < 0) rank[v] = next++;
    }
    // A face that uses a position twice has no area and no part in the surface.
    const auto degenerate = [&](int64_t f) {
        return at(f, 0) == at(f, 1) || at(f, 1) == at(f, 2) || at(f, 2) == at(f, 0);
    };

    std::vector<int64_t> begin(n_verts_ + 1, 0);
    for (int64_t f = 0; f < n_faces_; ++f) {
        if (f % check_every == 0) team.check();
        if (degenerate(f)) continue;
        for (int c = 0; c < 3; ++c) ++begin[std::min(at(f, c), at(f, c + 1)) + 1];
    }
    std::partial_sum(begin.begin(), begin.end(), begin.begin());
    std::vector<BucketedHalfEdge> entries(begin.back());
    std::vector<int64_t> fill(begin.begin(), begin.end() - 1);
    for (int64_t f = 0; f < n_faces_; ++f) {
        if (f % check_every == 0) team.check();
        if (degenerate(f)) continue;
        for (int c = 0; c < 3; ++c) {
            const int32_t a = at(f, c), b = at(f, c + 1);
            entries[fill[std::min(a, b)]++] = {std::max(a, b), {int32_t(f), int8_t(c), a > b}};
        }
    }
    offset_.assign(1, 0);
    half_edge_.resize(entries.size());
    face_.resize(entries.size());
    for (int64_t v = 0; v < n_verts_; ++v) {
        if (v % check_every == 0) team.check();
        const auto first = entries.begin() + begin[v], last = entries.begin() + begin[v + 1];
        std::stable_sort(first, last,
                         [](const BucketedHalfEdge& a, const BucketedHalfEdge& b) { return a.upper < b.upper; });
        for (auto e = first; e != last; ++e) {
            const int64_t i = e - entries.begin();
            half_edge_[i] = e->half_edge;
            face_[i] = e->half_edge.face;
            if (e + 1 == last || (e + 1)->upper != e->upper) offset_.push_back(i + 1);
        }
    }
    joins_two_.resize(n_edges());
    has_all_neighbours_.assign(n_faces_, 1);
    DisjointSets sets(n_faces_);
    // The first half-edge defines the direction of an edge.
    for (int64_t e = 0; e < n_edges(); ++e) {
        if (e % check_every == 0) team.check();
        const bool flip = half_edge_[offset_[e]].backwards;
        for (int64_t i = offset_[e]; i < offset_[e + 1]; ++i) half_edge_[i].backwards ^= flip;
        joins_two_[e] = offset_[e + 1] - offset_[e] == 2 && half_edge_[offset_[e] + 1].backwards;
        if (joins_two_[e]) sets.join(half_edges(e)[0].face, half_edges(e)[1].face);
        else
            for (const HalfEdge& h : half_edges(e)) has_all_neighbours_[h.face] = 0;
    }
    surface_.resize(n_faces_);
    for (int64_t f = 0; f < n_faces_; ++f) surface_[f] = sets.first(int32_t(f));
}

}  // namespace edgegrad
