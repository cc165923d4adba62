#include "scene/intersections.h"

#include <algorithm>
#include <atomic>
#include <bit>
#include <tuple>
#include <utility>

#include "core/array.h"
#include "core/sampler.h"
#include "scene/face_pair.h"
#include "scene/height_field.h"

namespace edgegrad {

namespace {

// A side of the face `beside` that lies in the face `through`, with that face itself on one side.
struct AlongEdge {
    int32_t through, beside;
    int32_t edge[2];  // vertices, ascending
    bool before;
    Vec3 a, b;

    bool on_same_edge(const AlongEdge& o) const {
        return through == o.through && edge[0] == o.edge[0] && edge[1] == o.edge[1];
    }
};

// What was found among some faces.
struct Found {
    std::vector<Intersection> through;
    std::vector<AlongEdge> along;
};

// A tangle of noise, or a soup of large triangles, has so many intersections that finding them all would take longer
// than all else, and most of them are hidden. So from one for each face on, some are drawn, by pairs of leaves. How
// many there are is estimated from so many leaves; where there are not much more of these, all are searched.
constexpr int64_t enough_intersections = 1 << 15, leaves_in_pilot = 128, most_in_pilot = 32;
constexpr int64_t leaves_in_block = 16;

class PairFinder {
   public:
    PairFinder(const FaceTree& tree, const HeightFields& fields, const int32_t* faces, const double* verts,
               const Spacing& spacing)
        : tree_(tree),
          fields_(fields),
          faces_(faces),
          verts_(verts),
          spacing_(spacing),
          coarsest_(spacing.coarsest()) {}

    // Calls found(other) for the leaves from this one on that overlap it, where faces may pass through each other.
    template <class Found>
    void each_overlapping(int64_t leaf, Found found) const {
        if (!fields_.crossed(leaf)) return;
        tree_.each_leaf(tree_.bounds(leaf), leaf, fields_.but(leaf), [&](int64_t other) {
            if (fields_.crossed(leaf, other)) found(other);
            return true;
        });
    }

    // Adds the pairs with a face of either leaf.
    void add(int64_t leaf, int64_t other, Found& out) {
        if (leaf != leaf_) place(leaf);
        const BoxGroup &own = tree_.leaf(leaf), &others = tree_.leaf(other);
        unsigned any = 0, met_by[FaceTree::leaf_size];  // of the other leaf, each with those of this one
        for (unsigned hits = own.overlapping(tree_.bounds(other)); hits; hits &= hits - 1) {
            const int i = std::countr_zero(hits);
            unsigned met = others.overlapping(own.box(i));
            if (leaf == other) met &= ~0u << (i + 1);
            if (met) met &= tree_.corners(other).may_cross(plane_[i], coarsest_);
            for (; met; met &= met - 1) {
                const int j = std::countr_zero(met);
                met_by[j] = (any >> j & 1 ? met_by[j] : 0) | 1u << i, any |= 1u << j;
            }
        }
        PlacedFace placed;
        for (; any; any &= any - 1) {
            const int j = std::countr_zero(any);
            const int32_t face = tree_.face(other, j);
            place(placed, face);
            unsigned met = met_by[j] & tree_.corners(leaf).may_cross(plane_of(placed), coarsest_);
            for (; met; met &= met - 1) {
                const int i = std::countr_zero(met);
                add_pair(placed_[i], tree_.face(leaf, i), placed, face, out);
            }
        }
    }

   private:
    void place(int64_t leaf) {
        leaf_ = leaf;
        for (int i = 0; i < FaceTree::leaf_size; ++i)
            if (const int32_t f = tree_.face(leaf, i); f >= 0) place(placed_[i], f), plane_[i] = plane_of(placed_[i]);
    }
    void place(PlacedFace& placed, int32_t face) const {
        const int32_t* v = faces_ + 3 * int64_t(face);
        placed.set(verts_, v, spacing_.of(v[0]));
    }
    static FacePlane plane_of(const PlacedFace& f) {
        return {f.vertex, f.p[0], f.normal, f.normal_length, f.coordinate};
    }

    void add_pair(const PlacedFace& f, int32_t face, const PlacedFace& g, int32_t other, Found& out) {
        FacePair pair;
        // In the order of the faces, so that the same numbers are found whoever comes first.
        const bool ascending = face < other;
        const int32_t faces[2] = {std::min(face, other), std::max(face, other)};
        const FacePair::Kind kind = pair.set(ascending ? f : g, ascending ? g : f);
        if (kind == FacePair::Kind::through)
            out.through.push_back({.face = {faces[0], faces[1]}, .a = pair.a, .b = pair.b});
        if (kind != FacePair::Kind::along) return;
        const int32_t beside = faces[pair.lies_beside], *v = faces_ + 3 * int64_t(beside);
        const auto [low, high] = std::minmax(v[(pair.corner + 1) % 3], v[(pair.corner + 2) % 3]);
        out.along.push_back({faces[1 - pair.lies_beside], beside, {low, high}, pair.before, pair.a, pair.b});
    }

    const FaceTree& tree_;
    const HeightFields& fields_;
    const int32_t* const faces_;
    const double* const verts_;
    const Spacing& spacing_;
    const double coarsest_;
    int64_t leaf_ = -1;
    PlacedFace placed_[FaceTree::leaf_size];  // its faces
    FacePlane plane_[FaceTree::leaf_size];    // theirs
};

// Adds those at which a surface passes through: two faces of an edge, one on each side.
void add_along(std::vector<AlongEdge>& along, std::vector<Intersection>& out) {
    std::sort(along.begin(), along.end(), [](const AlongEdge& p, const AlongEdge& q) {
        return std::tie(p.through, p.edge[0], p.edge[1], p.before, p.beside) <
               std::tie(q.through, q.edge[0], q.edge[1], q.before, q.beside);
    });
    const auto add = [&](const AlongEdge& own, const AlongEdge& next) {
        const bool ascending = own.through < own.beside;
        out.push_back({.face = {std::min(own.through, own.beside), std::max(own.through, own.beside)},
                       .next = next.beside,
                       .beside = ascending,
                       .weight = 0.5,
                       .a = own.a,
                       .b = own.b});
    };
    for (size_t i = 0, end; i < along.size(); i = end) {
        for (end = i + 1; end < along.size() && along[end].on_same_edge(along[i]);) ++end;
        // Those behind come first. One of either, or copies of both.
        const size_t behind =
            std::count_if(along.begin() + i, along.begin() + end, [](const AlongEdge& e) { return !e.before; });
        if (2 * behind != end - i) continue;
        for (size_t k = 0; k < behind; ++k)
            add(along[i + k], along[i + behind + k]), add(along[i + behind + k], along[i + k]);
    }
}

// Divides what copies of faces have in common among them.
void share_among_copies(Array<Intersection>& all, const int32_t* faces, const double* verts, Team& team) {
    // Of where both faces lie, whatever the order of their corners.
    const auto place = [&](int32_t face) {
        uint64_t bits = 0;
        for (int i = 0; i < 3; ++i) {
            const double* p = verts + 3 * int64_t(faces[3 * int64_t(face) + i]);
            bits += hash(std::bit_cast<uint64_t>(p[0] + 0.0), std::bit_cast<uint64_t>(p[1] + 0.0),
                         std::bit_cast<uint64_t>(p[2] + 0.0));
        }
        return hash(bits, 0);
    };
    const int64_t n = all.size();
    Array<uint64_t> key(n);
    team.each_block(n, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) key[i] = place(all[i].face[0]) + place(all[i].face[1]);
    });
    // Nearly all are alone: a table of bits finds those that may not be.
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
        for (size_t k = i; k < end; ++k) all[several[k].second].weight /= double(end - i);
    }
}

// All parts by ascending faces: those of each lower face side by side, and these, which are few, in order.
Array<Intersection> sorted(const std::vector<std::vector<Intersection>>& parts, int64_t n_faces, Team& team) {
    size_t n = 0;
    for (const auto& part : parts) n += part.size();
    Array<Intersection> all{int64_t(n)};
    if (n == 0) return all;
    std::vector<uint32_t> end(n_faces, 0);  // of each face, in `all`
    const auto each = [&](auto body) {
        team.each(int64_t(parts.size()), [&](int64_t k) {
            for (const Intersection& i : parts[k]) body(std::atomic_ref(end[i.face[0]]), i);
        });
    };
    each([](auto count, const Intersection&) { count.fetch_add(1, std::memory_order_relaxed); });
    uint32_t sum = 0;
    for (uint32_t& e : end) sum += std::exchange(e, sum);
    each([&](auto at, const Intersection& i) { all[at.fetch_add(1, std::memory_order_relaxed)] = i; });
    team.each_block(n_faces, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t f = first; f < last; ++f)
            std::sort(all.begin() + (f ? end[f - 1] : 0), all.begin() + end[f],
                      [](const Intersection& a, const Intersection& b) {
                          return std::tie(a.face[1], a.next, a.beside) < std::tie(b.face[1], b.next, b.beside);
                      });
    });
    return all;
}

}  // namespace

Intersections::Intersections(const int32_t* faces, int64_t n_faces, const double* verts, const Spacing& spacing,
                             const Topology& topology, FaceOrder& order, Team& team) {
    const bool kept_order = !order.face.empty();
    FaceTree tree(faces, n_faces, verts, topology, order, team);
    HeightFields fields(tree, topology, team);
    const auto finder = [&] { return std::make_unique<PairFinder>(tree, fields, faces, verts, spacing); };
    const int64_t leaves = tree.n_leaves();
    const auto share_to_draw = [&] {
        const int64_t step = leaves / leaves_in_pilot;
        if (step < 2) return 1.0;
        std::vector<double> expected(leaves_in_pilot);  // of the leaves for which each of them stands
        team.each_with(leaves_in_pilot, finder, [&](PairFinder& pairs, int64_t i) {
            const int64_t leaf = i * step;
            int64_t others = 0;
            pairs.each_overlapping(leaf, [&](int64_t) { ++others; });
            const double part = std::min(1.0, double(most_in_pilot) / double(std::max<int64_t>(1, others)));
            Found found;
            pairs.each_overlapping(leaf, [&](int64_t other) {
                if (part == 1 || to_unit(hash(1, uint64_t(leaf), uint64_t(other))) < part)
                    pairs.add(leaf, other, found);
            });
            expected[i] = double(step) * double(found.through.size()) / part;
        });
        double all = 0;
        for (const double e : expected) all += e;
        return std::min(1.0, double(n_faces + enough_intersections) / all);
    };
    double share = share_to_draw();
    if (share < 1 && kept_order) {
        // What is drawn depends on the leaves, and must not on where the vertices were before.
        order = {};
        tree = FaceTree(faces, n_faces, verts, topology, order, team);
        fields = HeightFields(tree, topology, team);
        share = share_to_draw();
    }
    stands_for_ = 1 / share;
    // Others where the vertices are elsewhere, so that the mean over the steps of a fit is right.
    uint64_t seed = 0;
    for (int i = 0; i < 9; ++i) seed = hash(seed, std::bit_cast<uint64_t>(verts[3 * int64_t(faces[i / 3]) + i % 3]));
    const int64_t blocks = (leaves + leaves_in_block - 1) / leaves_in_block;
    std::vector<Found> found(blocks);
    team.each_with(blocks, finder, [&](PairFinder& pairs, int64_t block) {
        Found part;
        for (int64_t leaf = block * leaves_in_block; leaf < std::min(leaves, (block + 1) * leaves_in_block); ++leaf)
            pairs.each_overlapping(leaf, [&](int64_t other) {
                if (share == 1 || to_unit(hash(seed, uint64_t(leaf), uint64_t(other))) < share)
                    pairs.add(leaf, other, part);
            });
        found[block] = std::move(part);
    });
    std::vector<std::vector<Intersection>> parts(1);
    std::vector<AlongEdge> along;
    for (Found& part : found) {
        parts.push_back(std::move(part.through));
        along.insert(along.end(), part.along.begin(), part.along.end());
    }
    add_along(along, parts[0]);
    team.check();
    all_ = sorted(parts, n_faces, team);
    team.check();
    share_among_copies(all_, faces, verts, team);
    if (share < 1) order = {};  // there will be as many the next time, and then it may not be kept either
}

}  // namespace edgegrad
