#include "scene/intersections.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <map>
#include <tuple>
#include <utility>

#include "core/array.h"
#include "core/sampler.h"
#include "scene/face_pair.h"

namespace edgegrad {

namespace {

// Records a side of the face `ending` that lies in the face `through`, with `ending` on one side of it.
struct AlongEdge {
    int32_t through, ending;
    int32_t edge[2];  // vertices, ascending
    bool before;
    bool drawn;  // Otherwise it is only known to exist.
    Vec3 a, b;

    bool on_same_edge(const AlongEdge& o) const {
        return through == o.through && edge[0] == o.edge[0] && edge[1] == o.edge[1];
    }
    bool operator<(const AlongEdge& o) const {
        return std::tie(through, edge[0], edge[1], before, ending) <
               std::tie(o.through, o.edge[0], o.edge[1], o.before, o.ending);
    }
};

// Collects what was found among some faces.
struct FoundIntersections {
    std::vector<Intersection> through;
    std::vector<AlongEdge> along;
};

// A pilot of this many leaves estimates the number of intersections if there are twice as many leaves. All are found up
// to `most_to_find_all` plus one for each of some faces; otherwise, samples are drawn.
constexpr int64_t leaves_in_pilot = 128, most_in_pilot = 32;
constexpr int64_t most_to_find_all = 1 << 12, faces_for_one_found = 8, most_drawn = 1 << 14, faces_for_one_drawn = 2;
constexpr int64_t leaves_in_block = 16;

// Selects the faces among which intersections are searched. They are all faces, or, if the leaves have masks, the drawn
// faces in pairs of leaves that are drawn, too.
struct DrawnPairs {
    std::vector<uint8_t> faces_of_leaf;
    const float* share = nullptr;   // (F,) probability of each face
    const float* copies = nullptr;  // (F,) 1 over the number of copies of each face
    double leaves = 1;              // probability of a pair of leaves
    uint64_t seed = 0;

    bool all() const { return faces_of_leaf.empty(); }
    unsigned in(int64_t leaf) const { return all() ? ~0u : faces_of_leaf[leaf]; }
    bool has(int64_t leaf, int64_t other) const {
        return in(other) && (leaves == 1 || to_unit(hash(seed, uint64_t(leaf), uint64_t(other))) < leaves);
    }
    // Returns how many pairs a pair of faces represents, divided among its copies, if `face` and `by` were drawn.
    double weight(int32_t face, int32_t other, int32_t by) const {
        return all() ? 1 : double(copies[face]) * double(copies[other]) / (double(share[face]) * share[by] * leaves);
    }
    double weight(int32_t face, int32_t other) const { return weight(face, other, other); }
    // Returns which of two faces at an edge represents both.
    const AlongEdge& likelier(const AlongEdge& a, const AlongEdge& b) const {
        return all() || share[a.ending] >= share[b.ending] ? a : b;
    }
};

// Holds the number of a face, and its geometry.
struct NumberedFace {
    const PlacedFace& placed;
    int32_t face;
};

PlacedFace placed(const PlacedFaces& faces, int32_t face) {
    const int32_t* v = faces.faces + 3 * int64_t(face);
    PlacedFace out;
    out.set(faces.verts, v, faces.spacing.of(v[0]));
    return out;
}

// Adds the intersection of two faces.
void add_pair(const NumberedFace& one, const NumberedFace& other, const DrawnPairs& drawn, FoundIntersections& out) {
    // Ordering the faces gives the same numbers whichever comes first.
    const auto [f, g] = one.face < other.face ? std::tie(one, other) : std::tie(other, one);
    FacePair pair;
    const FacePair::Kind kind = pair.set(f.placed, g.placed);
    if (kind == FacePair::Kind::through)
        out.through.push_back(
            {.face = {f.face, g.face}, .weight = drawn.weight(f.face, g.face), .a = pair.a, .b = pair.b});
    if (kind != FacePair::Kind::along) return;
    const auto [ending, through] = pair.lies_along ? std::tie(g, f) : std::tie(f, g);
    const int32_t* v = ending.placed.vertex;
    const auto [low, high] = std::minmax(v[(pair.corner + 1) % 3], v[(pair.corner + 2) % 3]);
    out.along.push_back({.through = through.face,
                         .ending = ending.face,
                         .edge = {low, high},
                         .before = pair.before,
                         .drawn = true,
                         .a = pair.a,
                         .b = pair.b});
}

class FacePairFinder {
   public:
    FacePairFinder(const FaceTree& tree, const HeightFields& fields, const PlacedFaces& faces, const DrawnPairs& drawn)
        : tree_(tree), fields_(fields), faces_(faces), drawn_(drawn), coarsest_(faces.spacing.coarsest()) {}

    // Calls found(other) for leaves from this one on that overlap it, if drawn faces may pass through each other.
    template <class FoundIntersections>
    void each_overlapping(int64_t leaf, FoundIntersections found) const {
        if (!drawn_.in(leaf) || !fields_.crossed(leaf)) return;
        tree_.each_leaf(tree_.bounds(leaf), leaf, fields_.but(leaf), [&](int64_t other) {
            if (drawn_.has(leaf, other) && fields_.crossed(leaf, other)) found(other);
            return true;
        });
    }

    // Adds the pairs of a face of either leaf.
    void add(int64_t leaf, int64_t other, FoundIntersections& out) {
        if (leaf != leaf_) place(leaf);
        const BoxGroup &own = tree_.leaf(leaf), &others = tree_.leaf(other);
        // They are masks over the other leaf; each entry is a mask over this one.
        unsigned any = 0, met_by[FaceTree::leaf_size];
        for (unsigned hits = own.overlapping(tree_.bounds(other)) & drawn_.in(leaf); hits; hits &= hits - 1) {
            const int i = std::countr_zero(hits);
            unsigned met = others.overlapping(own.box(i)) & drawn_.in(other);
            if (leaf == other) met &= ~0u << (i + 1);
            if (met) met &= tree_.corners(other).may_cross(plane_[i], coarsest_);
            for (; met; met &= met - 1) {
                const int j = std::countr_zero(met);
                met_by[j] = (any >> j & 1 ? met_by[j] : 0) | 1u << i, any |= 1u << j;
            }
        }
        for (; any; any &= any - 1) {
            const int j = std::countr_zero(any);
            const int32_t face = tree_.face(other, j);
            const PlacedFace placed = edgegrad::placed(faces_, face);
            unsigned met = met_by[j] & tree_.corners(leaf).may_cross(plane_of(placed), coarsest_);
            for (; met; met &= met - 1) {
                const int i = std::countr_zero(met);
                add_pair({placed_[i], tree_.face(leaf, i)}, {placed, face}, drawn_, out);
            }
        }
    }

   private:
    void place(int64_t leaf) {
        leaf_ = leaf;
        for (int i = 0; i < FaceTree::leaf_size; ++i)
            if (const int32_t f = tree_.face(leaf, i); f >= 0)
                placed_[i] = placed(faces_, f), plane_[i] = plane_of(placed_[i]);
    }
    static FacePlane plane_of(const PlacedFace& f) {
        return {f.vertex, f.p[0], f.normal, f.normal_length, f.coordinate};
    }

    const FaceTree& tree_;
    const HeightFields& fields_;
    const PlacedFaces& faces_;
    const DrawnPairs& drawn_;
    const double coarsest_;
    int64_t leaf_ = -1;
    PlacedFace placed_[FaceTree::leaf_size];  // its faces
    FacePlane plane_[FaceTree::leaf_size];    // planes of its faces
};

// Lists the faces at some edges, by the edges' vertices.
using FacesAtEdges = std::map<std::array<int32_t, 2>, std::vector<int32_t>>;
void find_faces(FacesAtEdges& at, const PlacedFaces& faces) {
    std::vector<uint8_t> wanted;  // marks vertices
    for (const auto& [edge, none] : at) {
        wanted.resize(std::max<size_t>(wanted.size(), edge[1] + 1), 0);
        wanted[edge[0]] = wanted[edge[1]] = 1;
    }
    const auto is_wanted = [&](int32_t v) { return size_t(v) < wanted.size() && wanted[v]; };
    for (int64_t e = 0; e < faces.topology.n_edges(); ++e)
        for (const HalfEdge& h : faces.topology.half_edges(e)) {
            const int32_t* v = faces.faces + 3 * int64_t(h.face);
            const auto [low, high] = std::minmax(v[h.first()], v[h.second()]);
            if (!is_wanted(low) || !is_wanted(high)) continue;
            if (const auto found = at.find({low, high}); found != at.end()) found->second.push_back(h.face);
        }
}

// Adds the other faces at the same edges, drawn or not. One side shows that the surface passes through only together
// with the other, which is mostly hidden. The one with the higher probability represents both.
void add_other_sides(std::vector<AlongEdge>& along, const PlacedFaces& faces, const DrawnPairs& drawn) {
    std::sort(along.begin(), along.end());
    FacesAtEdges at;
    for (const AlongEdge& a : along) at[{a.edge[0], a.edge[1]}];
    find_faces(at, faces);
    std::vector<AlongEdge> others;
    for (size_t i = 0, end; i < along.size(); i = end) {
        for (end = i + 1; end < along.size() && along[end].on_same_edge(along[i]);) ++end;
        const int32_t through = along[i].through;
        const PlacedFace own = placed(faces, through);
        for (const int32_t f : at[{along[i].edge[0], along[i].edge[1]}]) {
            if (std::any_of(along.begin() + i, along.begin() + end, [&](const AlongEdge& a) { return a.ending == f; }))
                continue;
            FoundIntersections found;
            add_pair({own, through}, {placed(faces, f), f}, drawn, found);
            for (AlongEdge& a : found.along)
                if (a.ending == f && a.on_same_edge(along[i])) a.drawn = false, others.push_back(a);
        }
    }
    along.insert(along.end(), others.begin(), others.end());
}

// Adds the edges at which a surface passes through: two faces of an edge, one on each side.
void add_along(std::vector<AlongEdge>& along, const DrawnPairs& drawn, std::vector<Intersection>& out) {
    std::sort(along.begin(), along.end());
    const auto add = [&](const AlongEdge& own, const AlongEdge& next, const AlongEdge& by) {
        const bool ascending = own.through < own.ending;
        out.push_back({.face = {std::min(own.through, own.ending), std::max(own.through, own.ending)},
                       .next = next.ending,
                       .ending = ascending,
                       .weight = 0.5 * drawn.weight(own.through, own.ending, by.ending),
                       .a = own.a,
                       .b = own.b});
    };
    for (size_t i = 0, end; i < along.size(); i = end) {
        for (end = i + 1; end < along.size() && along[end].on_same_edge(along[i]);) ++end;
        // Edges behind come first. There is one of each, or copies of both.
        const size_t behind =
            std::count_if(along.begin() + i, along.begin() + end, [](const AlongEdge& e) { return !e.before; });
        if (2 * behind != end - i) continue;
        for (size_t k = i; k < i + behind; ++k) {
            const AlongEdge &one = along[k], &other = along[k + behind], &by = drawn.likelier(one, other);
            if (by.drawn) add(one, other, by), add(other, one, by);
        }
    }
}

// Returns a hash of a face's position, independent of the order of its corners.
uint64_t place_of(const PlacedFaces& faces, int32_t face) {
    uint64_t bits = 0;
    for (int i = 0; i < 3; ++i) {
        const double* p = faces.verts + 3 * int64_t(faces.faces[3 * int64_t(face) + i]);
        bits += hash(std::bit_cast<uint64_t>(p[0] + 0.0), std::bit_cast<uint64_t>(p[1] + 0.0),
                     std::bit_cast<uint64_t>(p[2] + 0.0));
    }
    return hash(bits, 0);
}

// Calls body(i, n) for those keys i of which there are n > 1.
template <class Body>
void each_of_several(const Array<uint64_t>& key, Body body) {
    const int64_t n = key.size();
    // Nearly all are unique; a table of bits finds those that may not be.
    const uint64_t bits = std::bit_ceil(uint64_t(std::max<int64_t>(n, 4)) * 16);
    std::vector<uint64_t> once(bits / 64, 0), again(bits / 64, 0);
    const auto word = [&](uint64_t k) { return (k & (bits - 1)) / 64; };
    for (const uint64_t k : key) {
        const uint64_t bit = uint64_t(1) << (k & 63);
        again[word(k)] |= once[word(k)] & bit, once[word(k)] |= bit;
    }
    std::vector<std::pair<uint64_t, int64_t>> several;
    for (int64_t i = 0; i < n; ++i)
        if (again[word(key[i])] >> (key[i] & 63) & 1) several.emplace_back(key[i], i);
    std::sort(several.begin(), several.end());
    for (size_t i = 0, end; i < several.size(); i = end) {
        for (end = i + 1; end < several.size() && several[end].first == several[i].first;) ++end;
        for (size_t k = i; k < end && end > i + 1; ++k) body(several[k].second, end - i);
    }
}

// Divides the intersections of copies of faces among them, if all are known.
void share_among_copies(Array<Intersection>& all, const PlacedFaces& faces, ThreadTeam& team) {
    Array<uint64_t> key(all.size());
    team.parallel_for_blocks(all.size(), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i)
            key[i] = place_of(faces, all[i].face[0]) + place_of(faces, all[i].face[1]);
    });
    each_of_several(key, [&](int64_t i, size_t n) { all[i].weight /= double(n); });
}

// Returns each face's share: 1 over the number of its copies.
Array<float> shares_of_copies(const PlacedFaces& faces, ThreadTeam& team) {
    Array<uint64_t> key(faces.n_faces);
    Array<float> share(faces.n_faces);
    team.parallel_for_blocks(faces.n_faces, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t f = first; f < last; ++f) key[f] = place_of(faces, int32_t(f)), share[f] = 1;
    });
    each_of_several(key, [&](int64_t f, size_t n) { share[f] /= float(n); });
    return share;
}

// Sorts all parts by faces: those of each lower face become adjacent, and these few are sorted.
Array<Intersection> sorted(const std::vector<std::vector<Intersection>>& parts, int64_t n_faces, ThreadTeam& team) {
    size_t n = 0;
    for (const auto& part : parts) n += part.size();
    Array<Intersection> all{int64_t(n)};
    if (n == 0) return all;
    std::vector<uint32_t> end(n_faces, 0);  // end of each face's range in `all`
    const auto each = [&](auto body) {
        team.parallel_for(int64_t(parts.size()), [&](int64_t k) {
            for (const Intersection& i : parts[k]) body(std::atomic_ref(end[i.face[0]]), i);
        });
    };
    each([](auto count, const Intersection&) { count.fetch_add(1, std::memory_order_relaxed); });
    uint32_t sum = 0;
    for (uint32_t& e : end) sum += std::exchange(e, sum);
    each([&](auto at, const Intersection& i) { all[at.fetch_add(1, std::memory_order_relaxed)] = i; });
    team.parallel_for_blocks(n_faces, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t f = first; f < last; ++f)
            std::sort(all.begin() + (f ? end[f - 1] : 0), all.begin() + end[f],
                      [](const Intersection& a, const Intersection& b) {
                          return std::tie(a.face[1], a.next, a.ending) < std::tie(b.face[1], b.next, b.ending);
                      });
    });
    return all;
}

// Finds the intersections of the drawn faces, sorted by faces.
Array<Intersection> found(const FaceTree& tree, const HeightFields& fields, const PlacedFaces& faces,
                          const DrawnPairs& drawn, ThreadTeam& team) {
    const int64_t leaves = tree.n_leaves(), blocks = (leaves + leaves_in_block - 1) / leaves_in_block;
    std::vector<FoundIntersections> of_block(blocks);
    team.parallel_for_with_state(
        blocks, [&] { return std::make_unique<FacePairFinder>(tree, fields, faces, drawn); },
        [&](FacePairFinder& pairs, int64_t block) {
            FoundIntersections part;
            for (int64_t leaf = block * leaves_in_block; leaf < std::min(leaves, (block + 1) * leaves_in_block); ++leaf)
                pairs.each_overlapping(leaf, [&](int64_t other) { pairs.add(leaf, other, part); });
            of_block[block] = std::move(part);
        });
    std::vector<std::vector<Intersection>> parts(1);
    std::vector<AlongEdge> along;
    for (FoundIntersections& part : of_block) {
        parts.push_back(std::move(part.through));
        along.insert(along.end(), part.along.begin(), part.along.end());
    }
    if (!drawn.all() && !along.empty()) add_other_sides(along, faces, drawn);
    add_along(along, drawn, parts[0]);
    team.check();
    return sorted(parts, faces.n_faces, team);
}

}  // namespace

// Returns the pairs of a sample of leaves, if there are many leaves.
std::vector<Intersections::IntersectingPair> Intersections::some_pairs(const PlacedFaces& faces,
                                                                       ThreadTeam& team) const {
    const int64_t step = tree_->n_leaves() / leaves_in_pilot;
    if (step < 2) return {};
    const DrawnPairs all;
    std::vector<std::vector<IntersectingPair>> of_leaf(leaves_in_pilot);
    team.parallel_for_with_state(
        leaves_in_pilot, [&] { return std::make_unique<FacePairFinder>(*tree_, *fields_, faces, all); },
        [&](FacePairFinder& pairs, int64_t i) {
            const int64_t leaf = i * step;
            int64_t others = 0;
            pairs.each_overlapping(leaf, [&](int64_t) { ++others; });
            const double part = std::min(1.0, double(most_in_pilot) / double(std::max<int64_t>(1, others)));
            FoundIntersections found;
            pairs.each_overlapping(leaf, [&](int64_t other) {
                if (part == 1 || to_unit(hash(1, uint64_t(leaf), uint64_t(other))) < part)
                    pairs.add(leaf, other, found);
            });
            for (const Intersection& f : found.through)
                of_leaf[i].push_back({{f.face[0], f.face[1]}, double(step) / part});
        });
    std::vector<IntersectingPair> out;
    for (const auto& pairs : of_leaf) out.insert(out.end(), pairs.begin(), pairs.end());
    return out;
}

Intersections::Intersections(const PlacedFaces& faces, FaceOrder& order, ThreadTeam& team) : order_(std::move(order)) {
    const auto expected = [&] {
        tree_ = std::make_unique<FaceTree>(faces.faces, faces.n_faces, faces.verts, faces.topology, order_, team);
        fields_ = std::make_unique<HeightFields>(*tree_, faces.topology, team);
        pilot_ = some_pairs(faces, team);
        double sum = 0;
        for (const IntersectingPair& p : pilot_) sum += p.stands_for;
        return sum;
    };
    const double most = double(most_to_find_all + faces.n_faces / faces_for_one_found);
    const bool kept_order = !order_.face.empty();
    double n = expected();
    // The leaves decide what is drawn; they must not depend on earlier positions of the vertices.
    if (kept_order && n > most / 2) order_ = {}, n = expected();
    const bool drawn = n > most;
    if (drawn) {
        copies_ = shares_of_copies(faces, team);
        return;
    }
    all_ = found(*tree_, *fields_, faces, {}, team);
    team.check();
    share_among_copies(all_, faces, team);
    order = std::move(order_);
    fields_.reset(), tree_.reset(), pilot_ = {};
}

Array<Intersection> Intersections::drawn(const PlacedFaces& faces, const Array<float>& share, uint64_t seed,
                                         ThreadTeam& team) const {
    double expected = 0;
    for (const IntersectingPair& p : pilot_)
        expected += p.stands_for * double(share[p.face[0]]) * double(share[p.face[1]]);
    const double most = double(most_drawn + faces.n_faces / faces_for_one_drawn);
    DrawnPairs some{.faces_of_leaf = std::vector<uint8_t>(tree_->n_leaves(), 0),
                    .share = share.data(),
                    .copies = copies_.data(),
                    .leaves = expected > most ? most / expected : 1,
                    .seed = seed};
    team.parallel_for_blocks(tree_->n_leaves(), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t leaf = first; leaf < last; ++leaf)
            for (int lane = 0; lane < FaceTree::leaf_size; ++lane) {
                const int32_t f = tree_->face(leaf, lane);
                if (f < 0) continue;
                if (share[f] == 1 || to_unit(hash(seed, uint64_t(f))) < share[f]) some.faces_of_leaf[leaf] |= 1 << lane;
            }
    });
    return found(*tree_, *fields_, faces, some, team);
}

}  // namespace edgegrad
