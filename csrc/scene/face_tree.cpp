#include "scene/face_tree.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <tuple>

#include "core/math.h"
#include "scene/contact.h"

namespace edgegrad {

namespace {

// A surface of at least this many faces has its own nodes.
constexpr int32_t large_surface = 512;

constexpr float infinity = std::numeric_limits<float>::infinity();

// Holds the corners of eight faces in lanes.
struct CornerLanes {
    double p[3][3][BoxGroup::size];  // Indices are corner and axis.

    void set(int lane, const double* verts, const int32_t* v) {
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) p[i][k][lane] = verts[3 * int64_t(v[i]) + k];
    }
};

// Sets float boxes that contain the double ones. A float lies within half a spacing of its double.
EDGEGRAD_VECTORIZED void set_boxes(const CornerLanes& l, BoxGroup& boxes) {
    constexpr double most = 0x1p127;  // range of floats
    for (int k = 0; k < 3; ++k) {
        EDGEGRAD_ROLLED
        for (int i = 0; i < BoxGroup::size; ++i) {
            const double a = l.p[0][k][i], b = l.p[1][k][i], c = l.p[2][k][i];
            const double low = std::min(std::min(a, b), c), high = std::max(std::max(a, b), c);
            const float f = float(std::max(std::min(low, most), -most)),
                        g = float(std::max(std::min(high, most), -most));
            boxes.low[k][i] = f - (std::fabs(f) * 0x1p-23f + std::numeric_limits<float>::min());
            boxes.high[k][i] = g + (std::fabs(g) * 0x1p-23f + std::numeric_limits<float>::min());
        }
    }
}

EDGEGRAD_VECTORIZED void set_corners(const CornerLanes& l, CornerGroup& g) {
    const double origin[3] = {l.p[0][0][0], l.p[0][1][0], l.p[0][2][0]};
    float reach = 0;
    for (int c = 0; c < 3; ++c)
        for (int k = 0; k < 3; ++k) {
            float most = 0;
            EDGEGRAD_ROLLED
            for (int i = 0; i < BoxGroup::size; ++i) {
                const float x = float(l.p[c][k][i] - origin[k]);
                g.p[c][k][i] = x;
                most = std::max(most, std::fabs(x));
            }
            reach = std::max(reach, most);
        }
    g.origin = {origin[0], origin[1], origin[2]}, g.reach = reach;
}

struct FloatPlane {
    float x, y, z, offset, error;  // The plane is x p.x + y p.y + z p.z + offset.
    int32_t vertex[3];
};

EDGEGRAD_VECTORIZED unsigned crossing_lanes(const CornerGroup& g, const FloatPlane& plane) {
    constexpr int lanes = CornerGroup::size;
    const float x = plane.x, y = plane.y, z = plane.z, offset = plane.offset, error = plane.error;
    const int32_t v0 = plane.vertex[0], v1 = plane.vertex[1], v2 = plane.vertex[2];
    int32_t hit[lanes];
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) {
        // These are 1 where a corner belongs to the other face, where it lies before the plane, and where behind.
        const auto same = [&](int32_t v) { return int32_t(v == v0) | int32_t(v == v1) | int32_t(v == v2); };
        const auto at = [&](int c) { return x * g.p[c][0][i] + y * g.p[c][1][i] + z * g.p[c][2][i] + offset; };
        const int32_t s0 = same(g.vertex[0][i]), s1 = same(g.vertex[1][i]), s2 = same(g.vertex[2][i]);
        const float d0 = at(0), d1 = at(1), d2 = at(2);
        const int32_t before = (s0 | (d0 > error)) & (s1 | (d1 > error)) & (s2 | (d2 > error));
        const int32_t behind = (s0 | (d0 < -error)) & (s1 | (d1 < -error)) & (s2 | (d2 < -error));
        hit[i] = (before | behind | int32_t(s0 + s1 + s2 > 1) | int32_t(g.vertex[0][i] < 0)) ? 0 : 1 << i;
    }
    unsigned hits = 0;
    EDGEGRAD_ROLLED
    for (int i = 0; i < lanes; ++i) hits |= hit[i];
    return hits;
}

constexpr FaceBox empty{{infinity, infinity, infinity}, {-infinity, -infinity, -infinity}};

double size_of(const FaceBox& box) {
    double size = 0;
    for (int k = 0; k < 3; ++k) size += std::max(0.0, double(box.high[k]) - box.low[k]);
    return size;
}

// Moves the 21 bits of x three places apart.
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

EDGEGRAD_VECTORIZED unsigned overlapping_lanes(const BoxGroup& g, const OrientedBox& box) {
    float middle[3][BoxGroup::size], half[3][BoxGroup::size];
    for (int j = 0; j < 3; ++j) {
        EDGEGRAD_ROLLED
        for (int i = 0; i < BoxGroup::size; ++i) {
            // Halving comes first, because the sum may overflow a float.
            const float low = 0.5f * g.low[j][i], high = 0.5f * g.high[j][i];
            middle[j][i] = (low + high) - box.middle[j], half[j][i] = high - low;
        }
    }
    int32_t hit[BoxGroup::size];
    EDGEGRAD_ROLLED
    for (int i = 0; i < BoxGroup::size; ++i) hit[i] = 1 << i;
    for (int k = 0; k < 3; ++k) {
        const float x = box.axis[k][0], y = box.axis[k][1], z = box.axis[k][2], most = box.half[k];
        const float ax = std::fabs(x), ay = std::fabs(y), az = std::fabs(z);
        EDGEGRAD_ROLLED
        for (int i = 0; i < BoxGroup::size; ++i) {
            const float d = x * middle[0][i] + y * middle[1][i] + z * middle[2][i];
            const float reach = ax * half[0][i] + ay * half[1][i] + az * half[2][i] + most;
            hit[i] = (d <= reach) & (-d <= reach) ? hit[i] : 0;  // For an empty box, both are NaN.
        }
    }
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

FaceBox BoxGroup::box(int lane) const {
    FaceBox box;
    for (int k = 0; k < 3; ++k) box.low[k] = low[k][lane], box.high[k] = high[k][lane];
    return box;
}

unsigned BoxGroup::overlapping(const FaceBox& box) const { return overlapping_lanes(*this, box); }
unsigned BoxGroup::overlapping(const OrientedBox& box) const { return overlapping_lanes(*this, box); }

unsigned CornerGroup::may_cross(const FacePlane& plane, double spacing) const {
    const Vec3 N = plane.normal;
    const double own = std::max({std::fabs(origin.x), std::fabs(origin.y), std::fabs(origin.z)}) + reach;
    const double coordinate = std::max(plane.coordinate, own);
    const double touching = contact(spacing, coordinate, coordinate) * plane.normal_length;
    const double offset = dot(N, origin - plane.origin);
    const double size = (std::fabs(N.x) + std::fabs(N.y) + std::fabs(N.z)) * reach + std::fabs(offset);
    return crossing_lanes(*this, {.x = float(N.x),
                                  .y = float(N.y),
                                  .z = float(N.z),
                                  .offset = float(offset),
                                  // Four products and sums of rounded numbers have half a spacing each; this is twice
                                  // that. Overflow of floats rejects nothing.
                                  .error = float(0x1p-20 * size + touching) + std::numeric_limits<float>::min(),
                                  .vertex = {plane.vertex[0], plane.vertex[1], plane.vertex[2]}});
}

FaceTree::FaceTree(const int32_t* faces, int64_t n_faces, const double* verts, const Topology& topology,
                   FaceOrder& order, ThreadTeam& team) {
    for (int64_t n = n_faces; levels_.empty() || n > 1;) {
        n = (n + BoxGroup::size - 1) / BoxGroup::size;
        levels_.emplace_back(n);
    }
    corners_ = Array<CornerGroup>(n_leaves());
    face_ = &order.face;
    if (int64_t(order.face.size()) == n_faces) {
        make_boxes(faces, verts, team);
        find_surfaces(topology, team);
        // If boxes are half as large again, more than twice the pairs overlap.
        if (spread() <= 1.5 * order.spread) return;
    }
    // Returns the centroid of a face.
    const auto middle = [&](int64_t f) {
        const int32_t* v = faces + 3 * f;
        Vec3 m;
        for (int i = 0; i < 3; ++i) {
            const double* p = verts + 3 * int64_t(v[i]);
            m += (1.0 / 3) * Vec3{p[0], p[1], p[2]};
        }
        return m;
    };
    const auto parts = team.map_blocks(n_faces, [&](int64_t first, int64_t last) {
        Vec3 low = middle(first), high = low;
        for (int64_t f = first; f < last; ++f) {
            const Vec3 m = middle(f);
            low = {std::min(low.x, m.x), std::min(low.y, m.y), std::min(low.z, m.z)};
            high = {std::max(high.x, m.x), std::max(high.y, m.y), std::max(high.z, m.z)};
        }
        return std::array{low, high};
    });
    Vec3 low = parts[0][0], high = parts[0][1];
    for (const auto& [l, h] : parts) {
        low = {std::min(low.x, l.x), std::min(low.y, l.y), std::min(low.z, l.z)};
        high = {std::max(high.x, h.x), std::max(high.y, h.y), std::max(high.z, h.z)};
    }
    struct Key {
        int32_t surface;  // −1 means a small one.
        int32_t face;
        uint64_t code;
    };
    std::vector<int32_t> size(n_faces, 0);  // number of faces of each surface
    for (int64_t f = 0; f < n_faces; ++f) ++size[topology.surface(int32_t(f))];
    std::vector<Key> keys(n_faces);
    team.parallel_for_blocks(n_faces, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t f = first; f < last; ++f) {
            const Vec3 m = middle(f) - low, all = high - low;
            const auto bits = [](double place, double size) {
                return spread_bits(size > 0 ? uint64_t(std::clamp(place / size * 0x1p21, 0.0, 0x1p21 - 1)) : 0);
            };
            const uint64_t code = bits(m.x, all.x) | bits(m.y, all.y) << 1 | bits(m.z, all.z) << 2;
            const int32_t surface = topology.surface(int32_t(f));
            keys[f] = {size[surface] < large_surface ? -1 : surface, int32_t(f), code};
        }
    });
    team.check();
    std::sort(keys.begin(), keys.end(), [](const Key& a, const Key& b) {
        return std::tie(a.surface, a.code, a.face) < std::tie(b.surface, b.code, b.face);
    });
    order.face.resize(n_faces);
    for (int64_t i = 0; i < n_faces; ++i) order.face[i] = keys[i].face;
    make_boxes(faces, verts, team);
    find_surfaces(topology, team);
    order.spread = spread();
}

void FaceTree::make_boxes(const int32_t* faces, const double* verts, ThreadTeam& team) {
    const int64_t n_faces = int64_t(face_->size());
    team.parallel_for_blocks(n_leaves(), [&](int64_t, int64_t first, int64_t last) {
        CornerLanes lanes;
        for (int64_t i = first; i < last; ++i) {
            CornerGroup& corners = corners_[i];
            const int n = int(std::min<int64_t>(BoxGroup::size, n_faces - BoxGroup::size * i));
            for (int lane = 0; lane < BoxGroup::size; ++lane) {
                // The first face fills missing lanes.
                const int32_t* v = faces + 3 * int64_t((*face_)[BoxGroup::size * i + (lane < n ? lane : 0)]);
                lanes.set(lane, verts, v);
                for (int c = 0; c < 3; ++c) corners.vertex[c][lane] = lane < n ? v[c] : -1;
            }
            set_boxes(lanes, levels_[0][i]);
            set_corners(lanes, corners);
            for (int lane = n; lane < BoxGroup::size; ++lane) levels_[0][i].set(lane, empty);
        }
    });
    for (size_t level = 1; level < levels_.size(); ++level) {
        const Array<BoxGroup>& below = levels_[level - 1];
        team.parallel_for_blocks(levels_[level].size(), [&](int64_t, int64_t first, int64_t last) {
            for (int64_t i = first; i < last; ++i)
                for (int lane = 0; lane < BoxGroup::size; ++lane) {
                    const int64_t k = BoxGroup::size * i + lane;
                    levels_[level][i].set(lane, k < below.size() ? below[k].bounds() : empty);
                }
        });
    }
}

void FaceTree::find_surfaces(const Topology& topology, ThreadTeam& team) {
    constexpr int size = BoxGroup::size;
    surface_.clear();
    for (size_t level = 0; level < levels_.size(); ++level) surface_.emplace_back(levels_[level].size());
    team.parallel_for_blocks(n_leaves(), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            int32_t all = topology.surface(face(i, 0));
            for (int lane = 1; lane < size && all >= 0; ++lane)
                if (const int32_t f = face(i, lane); f >= 0 && topology.surface(f) != all) all = -1;
            surface_[0][i] = all;
        }
    });
    for (size_t level = 1; level < levels_.size(); ++level)
        for (int64_t i = 0; i < surface_[level].size(); ++i) {
            const Array<int32_t>& below = surface_[level - 1];
            int32_t all = below[size * i];
            for (int64_t k = size * i + 1; k < std::min(below.size(), size * (i + 1)); ++k)
                if (below[k] != all) all = -1;
            surface_[level][i] = all;
        }
}

// Returns the mean size of a leaf's box relative to the box of all.
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
