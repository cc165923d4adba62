#include "topology.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace edgegrad {

Parts::Parts(const int32_t* faces, int64_t n_faces, int64_t n_verts) : part_(n_verts) {
    // Disjoint sets, each named after its first vertex.
    std::vector<int32_t> up(n_verts);
    std::iota(up.begin(), up.end(), 0);
    const auto first_of = [&](int32_t v) {
        while (up[v] != v) v = up[v] = up[up[v]];
        return v;
    };
    for (int64_t i = 0; i < 3 * n_faces; ++i) {
        const int32_t a = first_of(faces[i]), b = first_of(faces[i - i % 3]);
        up[std::max(a, b)] = std::min(a, b);
    }
    for (int64_t v = 0; v < n_verts; ++v) part_[v] = up[v] == v ? size_++ : part_[up[v]];
}

Topology::Topology(const int32_t* faces, int64_t n_faces, int64_t n_verts)
    : faces_(faces), n_faces_(n_faces), n_verts_(n_verts) {
    build();
    std::vector<bool> on_border(n_verts, false);
    for (int64_t e = 0; e < n_edges(); ++e) {
        const auto edge = half_edges(e);
        if (edge.size() != 1) continue;
        const int32_t* f = faces_ + 3 * int64_t(edge[0].face);
        on_border[f[edge[0].corner]] = on_border[f[(edge[0].corner + 1) % 3]] = true;
    }
    for (int64_t v = 0; v < n_verts; ++v)
        if (on_border[v]) candidates_.push_back(int32_t(v));
}

void Topology::weld(const double* verts, double spacing) {
    if (candidates_.empty()) return;
    // Sorted along a direction that no mesh is aligned with, copies of a point stand next to each other.
    struct Key {
        double s;
        int32_t vertex;
    };
    std::vector<Key> order;
    order.reserve(candidates_.size());
    for (const int32_t v : candidates_) {
        const double* p = verts + 3 * int64_t(v);
        order.push_back({0.5257311 * p[0] + 0.6889372 * p[1] + 0.4991206 * p[2], v});
    }
    std::sort(order.begin(), order.end(),
              [](const Key& a, const Key& b) { return a.s < b.s || (a.s == b.s && a.vertex < b.vertex); });

    // Two copies that went through the same rotation and translation differ by a few roundings at most.
    const auto reach = [&](int32_t v) {
        const double* p = verts + 3 * int64_t(v);
        return 8 * spacing * std::max({std::fabs(p[0]), std::fabs(p[1]), std::fabs(p[2])});
    };
    std::vector<int32_t> welded(n_verts_);
    std::iota(welded.begin(), welded.end(), 0);
    bool any = false;
    for (size_t i = 0; i < order.size(); ++i) {
        const int32_t v = order[i].vertex;
        const double r = reach(v), *p = verts + 3 * int64_t(v);
        for (size_t j = i + 1; j < order.size() && order[j].s - order[i].s <= 2 * r; ++j) {
            const double* o = verts + 3 * int64_t(order[j].vertex);
            if (std::fabs(p[0] - o[0]) > r || std::fabs(p[1] - o[1]) > r || std::fabs(p[2] - o[2]) > r) continue;
            if (welded[order[j].vertex] == order[j].vertex) welded[order[j].vertex] = welded[v], any = true;
        }
    }
    if (!any) welded.clear();
    if (welded == welded_) return;
    welded_ = std::move(welded);
    build();
}

void Topology::build() {
    // Half-edges in buckets of their lower vertex, each bucket sorted by the upper one: linear in the number of faces.
    struct Entry {
        int32_t upper;
        HalfEdge half_edge;
    };
    const auto at = [&](int64_t face, int corner) {
        const int32_t v = faces_[3 * face + corner % 3];
        return welded_.empty() ? v : welded_[v];
    };
    // A face that uses a place twice has no area and no part in the surface.
    const auto degenerate = [&](int64_t f) {
        return at(f, 0) == at(f, 1) || at(f, 1) == at(f, 2) || at(f, 2) == at(f, 0);
    };

    std::vector<int64_t> begin(n_verts_ + 1, 0);
    for (int64_t f = 0; f < n_faces_; ++f) {
        if (degenerate(f)) continue;
        for (int c = 0; c < 3; ++c) ++begin[std::min(at(f, c), at(f, c + 1)) + 1];
    }
    std::partial_sum(begin.begin(), begin.end(), begin.begin());
    std::vector<Entry> entries(begin.back());
    std::vector<int64_t> fill(begin.begin(), begin.end() - 1);
    for (int64_t f = 0; f < n_faces_; ++f) {
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
        const auto first = entries.begin() + begin[v], last = entries.begin() + begin[v + 1];
        std::stable_sort(first, last, [](const Entry& a, const Entry& b) { return a.upper < b.upper; });
        for (auto e = first; e != last; ++e) {
            const int64_t i = e - entries.begin();
            half_edge_[i] = e->half_edge;
            face_[i] = e->half_edge.face;
            if (e + 1 == last || (e + 1)->upper != e->upper) offset_.push_back(i + 1);
        }
    }
    // The direction of an edge is that of its first half-edge.
    for (int64_t e = 0; e < n_edges(); ++e) {
        const bool flip = half_edge_[offset_[e]].backwards;
        for (int64_t i = offset_[e]; i < offset_[e + 1]; ++i) half_edge_[i].backwards ^= flip;
    }
}

}  // namespace edgegrad
