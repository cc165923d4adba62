#include "scene/intersections.h"

#include <algorithm>
#include <atomic>
#include <bit>

#include "core/sampler.h"
#include "scene/face_pair.h"

namespace edgegrad {

namespace {

// Leaves of the tree that overlap: their faces may meet.
struct LeafPair {
    int32_t first, second;
};

// Pairs of leaves for each leaf at most, in the mean: a surface has some five, a tangle of noise twenty. A soup of
// large triangles has as many as there are leaves, and is drawn from.
constexpr int64_t most_a_leaf = 24, most_at_least = 1 << 15;
constexpr int64_t leaves_in_block = 64;

class PairFinder {
   public:
    PairFinder(const FaceTree& tree, const int32_t* faces, const double* verts, const Spacing& spacing)
        : tree_(tree), faces_(faces), verts_(verts), spacing_(spacing) {}

    // Calls found(other) for the leaves from this one on that overlap it.
    template <class Found>
    void each_overlapping(int64_t leaf, Found found) const {
        tree_.each_leaf(tree_.leaf(leaf).bounds(), leaf, found);
    }

    // Adds the pairs with a face of either leaf.
    void add(int64_t leaf, int64_t other, std::vector<Intersection>& out) {
        if (leaf != leaf_) place(leaf);
        const BoxGroup &own = tree_.leaf(leaf), &others = tree_.leaf(other);
        for (unsigned hits = own.overlapping(others.bounds()); hits; hits &= hits - 1) {
            const int i = std::countr_zero(hits);
            const FaceBox box = {{own.low[0][i], own.low[1][i], own.low[2][i]},
                                 {own.high[0][i], own.high[1][i], own.high[2][i]}};
            unsigned met = others.overlapping(box);
            if (leaf == other) met &= ~0u << (i + 1);
            for (; met; met &= met - 1) {
                const int32_t g = tree_.face(other, std::countr_zero(met));
                if (may_cross(placed_[i], g)) add_pair(placed_[i], tree_.face(leaf, i), g, out);
            }
        }
    }

   private:
    void place(int64_t leaf) {
        leaf_ = leaf;
        for (int i = 0; i < FaceTree::leaf_size; ++i)
            if (const int32_t f = tree_.face(leaf, i); f >= 0) place(placed_[i], f);
    }
    void place(PlacedFace& placed, int32_t face) const {
        const int32_t* v = faces_ + 3 * int64_t(face);
        placed.set(verts_, v, spacing_.of(v[0]));
    }

    // Whether vertices of the face g may lie on both sides of the plane of f. Of most pairs this says all.
    bool may_cross(const PlacedFace& f, int32_t g) const {
        const double tolerance = rounding_of_doubles * f.coordinate * f.normal_length;
        double low = 0, high = 0;
        for (int i = 0; i < 3; ++i) {
            const int32_t v = faces_[3 * int64_t(g) + i];
            if (v == f.vertex[0] || v == f.vertex[1] || v == f.vertex[2]) continue;
            const double* q = verts_ + 3 * int64_t(v);
            const double d = dot(f.normal, Vec3{q[0], q[1], q[2]} - f.p[0]);
            low = std::min(low, d), high = std::max(high, d);
        }
        return low < -tolerance && high > tolerance;
    }

    void add_pair(const PlacedFace& f, int32_t face, int32_t other, std::vector<Intersection>& out) {
        PlacedFace g;
        place(g, other);
        FacePair pair;
        // In the order of the faces, so that the same numbers are added whoever finds the pair.
        const bool ascending = face < other;
        if (!pair.set(ascending ? f : g, ascending ? g : f)) return;
        out.push_back({{std::min(face, other), std::max(face, other)}, pair.a, pair.b});
    }

    const FaceTree& tree_;
    const int32_t* const faces_;
    const double* const verts_;
    const Spacing& spacing_;
    int64_t leaf_ = -1;
    PlacedFace placed_[FaceTree::leaf_size];  // its faces
};

}  // namespace

Intersections::Intersections(const int32_t* faces, int64_t n_faces, const double* verts, const Spacing& spacing,
                             FaceOrder& order, Team& team) {
    FaceTree tree(faces, n_faces, verts, order, team);
    const int64_t leaves = tree.n_leaves(), blocks = (leaves + leaves_in_block - 1) / leaves_in_block;
    const int64_t most = most_a_leaf * leaves + most_at_least;
    std::vector<std::vector<Intersection>> found(blocks);
    std::atomic<int64_t> total = 0;
    const auto each_leaf = [&](int64_t block, auto body) {
        for (int64_t i = block * leaves_in_block; i < std::min(leaves, (block + 1) * leaves_in_block); ++i) body(i);
    };
    const auto finder = [&] { return std::make_unique<PairFinder>(tree, faces, verts, spacing); };
    team.each_with(blocks, finder, [&](PairFinder& pairs, int64_t block) {
        each_leaf(block, [&](int64_t leaf) {
            if (total.load(std::memory_order_relaxed) > most) return;
            int64_t n = 0;
            pairs.each_overlapping(leaf, [&](int64_t other) { pairs.add(leaf, other, found[block]), ++n; });
            total.fetch_add(n, std::memory_order_relaxed);
        });
    });
    if (total > most) {
        // What is drawn depends on the leaves, and must not on where the vertices were before.
        order = {};
        tree = FaceTree(faces, n_faces, verts, order, team);
        total = 0;
        team.each_with(blocks, finder, [&](PairFinder& pairs, int64_t block) {
            found[block].clear();
            int64_t n = 0;
            each_leaf(block, [&](int64_t leaf) { pairs.each_overlapping(leaf, [&](int64_t) { ++n; }); });
            total.fetch_add(n, std::memory_order_relaxed);
        });
        // Others where the vertices are elsewhere, so that the mean over the steps of a fit is right.
        uint64_t seed = 0;
        for (int i = 0; i < 9; ++i)
            seed = hash(seed, std::bit_cast<uint64_t>(verts[3 * int64_t(faces[i / 3]) + i % 3]));
        const double share = double(most) / double(total);
        stands_for_ = 1 / share;
        team.each_with(blocks, finder, [&](PairFinder& pairs, int64_t block) {
            each_leaf(block, [&](int64_t leaf) {
                pairs.each_overlapping(leaf, [&](int64_t other) {
                    if (to_unit(hash(seed, uint64_t(leaf), uint64_t(other))) < share)
                        pairs.add(leaf, other, found[block]);
                });
            });
        });
    }
    size_t n = 0;
    for (const auto& part : found) n += part.size();
    all_.reserve(n);
    for (const auto& part : found) all_.insert(all_.end(), part.begin(), part.end());
    team.check();
    std::sort(all_.begin(), all_.end(), [](const Intersection& p, const Intersection& q) {
        return p.face[0] != q.face[0] ? p.face[0] < q.face[0] : p.face[1] < q.face[1];
    });
}

}  // namespace edgegrad
