// Holds a bounding volume hierarchy of the faces of an emissive mesh, which finds the faces in a direction. It works in
// double precision and ray by ray: each surface point asks for a few directions, and the answers decide about pdfs.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <vector>

#include "core/math.h"

namespace edgegrad {

class EmissiveFaceTree {
   public:
    // Larger meshes get no tree, because moving faces require a new one.
    static constexpr int64_t most_faces = 1 << 16;

    // Builds the tree of faces (F, 3) with vertices (V, 3) in world units.
    EmissiveFaceTree(const double* verts, int64_t n_verts, const int32_t* faces, int64_t n_faces) {
        const auto vertex = [&](int32_t v) { return Vec3{verts[3 * v], verts[3 * v + 1], verts[3 * v + 2]}; };
        Vec3 low = vertex(faces[0]), high = low;
        for (int64_t f = 0; f < n_faces; ++f) {
            const Vec3 q0 = vertex(faces[3 * f]), q1 = vertex(faces[3 * f + 1]), q2 = vertex(faces[3 * f + 2]);
            triangles_.push_back({q0, q1 - q0, q2 - q0, int32_t(f)});
            for (const Vec3 q : {q0, q1, q2}) low = least(low, q), high = most(high, q);
        }
        center_ = 0.5 * (low + high);
        for (const Triangle& t : triangles_) {
            for (int i = 0; i < 3; ++i) radius_ = std::max(radius_, length(t.corner(i) - center_));
            area_ += 0.5 * length(cross(t.e1, t.e2));
        }
        size_ = std::max({std::fabs(low.x), std::fabs(low.y), std::fabs(low.z), std::fabs(high.x), std::fabs(high.y),
                          std::fabs(high.z)});
        find_shape(verts, n_verts, faces);
        nodes_.reserve(2 * triangles_.size() / leaf_size + 2);
        nodes_.emplace_back();
        split(0, 0, int32_t(n_faces));
    }

    int64_t n_faces() const { return int64_t(triangles_.size()); }
    // These describe a bounding sphere of all faces, and the largest coordinate.
    Vec3 center() const { return center_; }
    double radius() const { return radius_; }
    double size() const { return size_; }
    double area() const { return area_; }
    // These say whether all faces lie in one plane, or bound a convex body and face outwards.
    bool is_flat() const { return flat_; }
    bool is_convex() const { return convex_; }
    // Returns whether most lines through the bounding sphere hit the faces. Of the lines that hit a convex body, the
    // fraction that hits a convex body inside it is the ratio of their surface areas (Crofton).
    bool fills_ball() const { return convex_ && area_ >= least_filled * 4 * M_PI * radius_ * radius_; }

    // Records where origin + t direction hits a face.
    struct Hit {
        int32_t face;
        double u, v, t;
    };
    // Calls found(hit) for hits with t in (start, end), near ones about first. It returns a new `end`.
    template <class Found>
    void each_hit(Vec3 origin, Vec3 direction, double start, double end, Found found) const {
        const Vec3 inverse{1 / direction.x, 1 / direction.y, 1 / direction.z};
        int32_t waiting[64], n = 0;  // The tree halves its faces at each level.
        waiting[n++] = 0;
        while (n) {
            const Node& node = nodes_[waiting[--n]];
            if (!node.meets(origin, inverse, start, end)) continue;
            if (!node.count) {
                const int forwards = along(direction, node.axis) >= 0;
                waiting[n++] = node.first + forwards, waiting[n++] = node.first + 1 - forwards;
                continue;
            }
            for (int32_t k = node.first; k < node.first + node.count; ++k) {
                Hit c;
                if (triangles_[k].meets(origin, direction, c) && c.t > start && c.t < end) end = found(c);
            }
        }
    }

   private:
    static constexpr int leaf_size = 4;
    static constexpr double least_filled = 0.5;
    // Float rounding may move vertices out of their plane by this part of the size.
    static constexpr double flatness = 1e-6;

    static Vec3 least(Vec3 a, Vec3 b) { return {std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)}; }
    static Vec3 most(Vec3 a, Vec3 b) { return {std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)}; }
    static double along(Vec3 v, int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

    struct Triangle {
        Vec3 q0, e1, e2;
        int32_t face;

        Vec3 corner(int i) const { return i == 0 ? q0 : q0 + (i == 1 ? e1 : e2); }
        // Möller and Trumbore 1997. A point within rounding of the edge counts as a hit, because the neighbour may be
        // missed as well.
        bool meets(Vec3 origin, Vec3 direction, Hit& c) const {
            constexpr double rounding = 1e-12;
            const Vec3 p = cross(direction, e2), s = origin - q0;
            const double scale = 1 / dot(e1, p);
            const double u = dot(s, p) * scale;
            if (!(u >= -rounding && u <= 1 + rounding)) return false;
            const Vec3 q = cross(s, e1);
            const double v = dot(direction, q) * scale;
            if (!(v >= -rounding && u + v <= 1 + rounding)) return false;
            c = {face, std::clamp(u, 0.0, 1.0), std::max(v, 0.0), dot(e2, q) * scale};
            c.v = std::min(c.v, 1 - c.u);
            return std::isfinite(c.t);
        }
    };
    struct Node {
        Vec3 low, high;
        // A leaf has triangles; an inner node has the index of its first child, and count 0.
        int32_t first = 0, count = 0;
        int axis = 0;  // The children follow one another along this axis.

        // Kay and Kajiya 1986. A ray in the plane of a side gives NaN.
        bool meets(Vec3 origin, Vec3 inverse, double start, double end) const {
            for (int axis = 0; axis < 3; ++axis) {
                const double i = along(inverse, axis), o = along(origin, axis);
                const double a = (along(low, axis) - o) * i, b = (along(high, axis) - o) * i;
                if (std::isnan(a) || std::isnan(b)) continue;
                start = std::max(start, std::min(a, b)), end = std::min(end, std::max(a, b));
            }
            // The margin covers a few roundings.
            return start <= end + 1e-14 * (std::fabs(start) + std::fabs(end));
        }
    };

    void split(int32_t node, int32_t first, int32_t last) {
        Vec3 low = triangles_[first].q0, high = low, low_middle, high_middle;
        for (int32_t k = first; k < last; ++k) {
            for (int i = 0; i < 3; ++i)
                low = least(low, triangles_[k].corner(i)), high = most(high, triangles_[k].corner(i));
            const Vec3 m = middle(triangles_[k]);
            low_middle = k == first ? m : least(low_middle, m), high_middle = k == first ? m : most(high_middle, m);
        }
        nodes_[node].low = low, nodes_[node].high = high;
        if (last - first <= leaf_size) return void((nodes_[node].first = first, nodes_[node].count = last - first));
        const Vec3 extent = high_middle - low_middle;
        const int axis = extent.x >= extent.y && extent.x >= extent.z ? 0 : extent.y >= extent.z ? 1 : 2;
        const int32_t half = (first + last) / 2;
        std::nth_element(triangles_.begin() + first, triangles_.begin() + half, triangles_.begin() + last,
                         [&](const Triangle& a, const Triangle& b) {
                             const double x = along(middle(a), axis), y = along(middle(b), axis);
                             return x != y ? x < y : a.face < b.face;
                         });
        const int32_t child = int32_t(nodes_.size());
        nodes_[node].first = child, nodes_[node].axis = axis;
        nodes_.emplace_back(), nodes_.emplace_back();
        split(child, first, half), split(child + 1, half, last);
    }
    static Vec3 middle(const Triangle& t) { return t.q0 + (1.0 / 3) * (t.e1 + t.e2); }

    void find_shape(const double* verts, int64_t n_verts, const int32_t* faces) {
        const double near = flatness * radius_;
        // Returns whether no vertex lies above a face.
        const auto is_side = [&](const Triangle& t, double sign) {
            const Vec3 n = sign * cross(t.e1, t.e2);
            const double most = dot(n, t.q0) + near * length(n);
            for (int64_t v = 0; v < n_verts; ++v)
                if (!(n.x * verts[3 * v] + n.y * verts[3 * v + 1] + n.z * verts[3 * v + 2] <= most)) return false;
            return true;
        };
        const Triangle* largest = &triangles_[0];
        const auto area = [](const Triangle& t) { return length(cross(t.e1, t.e2)); };
        for (const Triangle& t : triangles_)
            if (area(t) > area(*largest)) largest = &t;
        flat_ = is_side(*largest, 1) && is_side(*largest, -1);
        constexpr int64_t most_tests = 1 << 22;  // number of pairs of vertices and faces
        convex_ = !flat_ && n_verts * int64_t(triangles_.size()) <= most_tests &&
                  std::all_of(triangles_.begin(), triangles_.end(), [&](const Triangle& t) { return is_side(t, 1); }) &&
                  is_closed(verts, faces);
    }

    // Returns whether each edge is run along equally often in both directions; vertices at one position count as one.
    bool is_closed(const double* verts, const int32_t* faces) const {
        std::map<std::array<double, 3>, int> number;
        std::map<std::array<int, 2>, int> runs;
        for (size_t f = 0; f < triangles_.size(); ++f) {
            int v[3];
            for (int i = 0; i < 3; ++i) {
                const double* p = verts + 3 * int64_t(faces[3 * f + i]);
                v[i] = number.try_emplace({p[0], p[1], p[2]}, int(number.size())).first->second;
            }
            for (int i = 0; i < 3; ++i) {
                const int a = v[i], b = v[(i + 1) % 3];
                if (a != b) runs[{std::min(a, b), std::max(a, b)}] += a < b ? 1 : -1;
            }
        }
        return std::all_of(runs.begin(), runs.end(), [](const auto& run) { return run.second == 0; });
    }

    std::vector<Triangle> triangles_;
    std::vector<Node> nodes_;
    Vec3 center_;
    double radius_ = 0, size_ = 0, area_ = 0;
    bool flat_ = false, convex_ = false;
};

}  // namespace edgegrad
