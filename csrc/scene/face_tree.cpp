#include "scene/face_tree.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math.h"

namespace edgegrad {

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();

// What a float may lie below or above a double that was rounded to it.
float below(double x) { return std::nextafter(float(x), -infinity); }
float above(double x) { return std::nextafter(float(x), infinity); }

FaceBox box_of(const double* verts, const int32_t* v) {
    FaceBox box;
    for (int k = 0; k < 3; ++k) {
        const double a = verts[3 * int64_t(v[0]) + k], b = verts[3 * int64_t(v[1]) + k],
                     c = verts[3 * int64_t(v[2]) + k];
        box.low[k] = below(std::min({a, b, c})), box.high[k] = above(std::max({a, b, c}));
    }
    return box;
}

void include(FaceBox& all, const FaceBox& box) {
    for (int k = 0; k < 3; ++k)
        all.low[k] = std::min(all.low[k], box.low[k]), all.high[k] = std::max(all.high[k], box.high[k]);
}

constexpr FaceBox empty{{infinity, infinity, infinity}, {-infinity, -infinity, -infinity}};

double size_of(const FaceBox& box) {
    double size = 0;
    for (int k = 0; k < 3; ++k) size += std::max(0.0, double(box.high[k]) - box.low[k]);
    return size;
}

// The bits of x, of which there are 21, two places apart.
uint64_t spread_bits(uint64_t x) {
    x = (x | x << 32) & 0x001f00000000ffff, x = (x | x << 16) & 0x001f0000ff0000ff;
    x = (x | x << 8) & 0x100f00f00f00f00f, x = (x | x << 4) & 0x10c30c30c30c30c3;
    return (x | x << 2) & 0x1249249249249249;
}

EDGEGRAD_VECTORIZED unsigned overlapping_lanes(const BoxGroup& g, const FaceBox& box) {
    int32_t hit[BoxGroup::size];
    EDGEGRAD_ROLLED
    for (int i = 0; i < BoxGroup::size; ++i)
        hit[i] = (g.low[0][i] <= box.high[0]) & (g.high[0][i] >= box.low[0]) & (g.low[1][i] <= box.high[1]) &
                         (g.high[1][i] >= box.low[1]) & (g.low[2][i] <= box.high[2]) & (g.high[2][i] >= box.low[2])
                     ? 1 << i
                     : 0;
    unsigned hits = 0;
    EDGEGRAD_ROLLED
    for (int i = 0; i < BoxGroup::size; ++i) hits |= hit[i];
    return hits;
}

}  // namespace

void BoxGroup::set(int lane, const FaceBox& box) {
    for (int k = 0; k < 3; ++k) low[k][lane] = box.low[k], high[k][lane] = box.high[k];
}

FaceBox BoxGroup::bounds() const {
    FaceBox all = empty;
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < size; ++i)
            all.low[k] = std::min(all.low[k], low[k][i]), all.high[k] = std::max(all.high[k], high[k][i]);
    return all;
}

unsigned BoxGroup::overlapping(const FaceBox& box) const { return overlapping_lanes(*this, box); }

FaceTree::FaceTree(const int32_t* faces, int64_t n_faces, const double* verts, FaceOrder& order, Team& team) {
    for (int64_t n = n_faces; levels_.empty() || n > 1;) {
        n = (n + BoxGroup::size - 1) / BoxGroup::size;
        levels_.emplace_back(n);
    }
    face_ = &order.face;
    if (int64_t(order.face.size()) == n_faces) {
        make_boxes(faces, verts, team);
        // Half as large again, and more than twice the pairs overlap.
        if (spread() <= 1.5 * order.spread) return;
    }
    std::vector<FaceBox> parts(Team::blocks(n_faces), empty);
    team.each_block(n_faces, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t f = first; f < last; ++f) include(parts[k], box_of(verts, faces + 3 * f));
    });
    FaceBox all = empty;
    for (const FaceBox& part : parts) include(all, part);
    struct Key {
        uint64_t code;
        int32_t face;
    };
    std::vector<Key> keys(n_faces);
    team.each_block(n_faces, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t f = first; f < last; ++f) {
            const FaceBox box = box_of(verts, faces + 3 * f);
            uint64_t code = 0;
            for (int k = 0; k < 3; ++k) {
                const double place = (0.5 * (double(box.low[k]) + box.high[k]) - all.low[k]) /
                                     (double(all.high[k]) - all.low[k]) * 0x1p21;
                code |= spread_bits(uint64_t(std::clamp(place, 0.0, 0x1p21 - 1))) << k;
            }
            keys[f] = {code, int32_t(f)};
        }
    });
    team.check();
    std::sort(keys.begin(), keys.end(),
              [](const Key& a, const Key& b) { return a.code != b.code ? a.code < b.code : a.face < b.face; });
    order.face.resize(n_faces);
    for (int64_t i = 0; i < n_faces; ++i) order.face[i] = keys[i].face;
    make_boxes(faces, verts, team);
    order.spread = spread();
}

void FaceTree::make_boxes(const int32_t* faces, const double* verts, Team& team) {
    const int64_t n_faces = int64_t(face_->size());
    team.each_block(n_leaves(), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i)
            for (int lane = 0; lane < BoxGroup::size; ++lane) {
                const int64_t k = BoxGroup::size * i + lane;
                levels_[0][i].set(lane, k < n_faces ? box_of(verts, faces + 3 * int64_t((*face_)[k])) : empty);
            }
    });
    for (size_t level = 1; level < levels_.size(); ++level) {
        const Array<BoxGroup>& below = levels_[level - 1];
        team.each_block(levels_[level].size(), [&](int64_t, int64_t first, int64_t last) {
            for (int64_t i = first; i < last; ++i)
                for (int lane = 0; lane < BoxGroup::size; ++lane) {
                    const int64_t k = BoxGroup::size * i + lane;
                    levels_[level][i].set(lane, k < below.size() ? below[k].bounds() : empty);
                }
        });
    }
}

// Mean size of a leaf's box relative to that of all.
double FaceTree::spread() const {
    const double all = size_of(levels_.back()[0].bounds());
    if (levels_.size() == 1 || !(all > 0)) return 1;
    double sum = 0;
    for (const BoxGroup& group : levels_[1])
        for (int lane = 0; lane < BoxGroup::size; ++lane)
            sum += size_of({{group.low[0][lane], group.low[1][lane], group.low[2][lane]},
                            {group.high[0][lane], group.high[1][lane], group.high[2][lane]}});
    return sum / (all * double(n_leaves()));
}

}  // namespace edgegrad
