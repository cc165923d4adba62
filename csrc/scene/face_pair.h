// Intersects two triangles: the intersection is a segment of the line that their planes share.
//
// Each triangle cuts an interval out of that line, whose ends lie on sides that pass through the other plane. The
// segment is where both intervals overlap (Möller 1997, "A fast triangle-triangle intersection test").
//
// Only true crossings count: each triangle needs a vertex before the other's plane and one behind it. A vertex within
// the rounding of the input (contact.h) lies on the plane, and so does a shared vertex. Faces that share an edge, by
// index or by position, that touch, or that are coplanar, therefore have no segment. Where a side of one face lies in
// the other's plane, its surface may pass through there with the next face. That case has its own kind.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"
#include "scene/contact.h"

namespace edgegrad {

// Holds a face in the world, and what its pairs need.
struct PlacedFace {
    const int32_t* vertex;  // 3 elements
    Vec3 p[3];
    Vec3 e1, e2, normal;  // not normalised
    double normal_length;
    double coordinate;  // largest of the face's coordinates
    double spacing;     // relative spacing of the input's numbers

    void set(const double* verts, const int32_t* v, double spacing_) {
        vertex = v, spacing = spacing_, coordinate = 0;
        for (int i = 0; i < 3; ++i) {
            const double* q = verts + 3 * int64_t(v[i]);
            p[i] = {q[0], q[1], q[2]};
            coordinate = std::max({coordinate, std::fabs(q[0]), std::fabs(q[1]), std::fabs(q[2])});
        }
        e1 = p[1] - p[0], e2 = p[2] - p[0];
        normal = cross(e1, e2);
        normal_length = length(normal);
    }
};

class FacePair {
   public:
    Vec3 a, b;  // ends of the segment

    // `along` means that a side of one face lies in the other one, with that face on one side of it.
    enum class Kind { none, through, along };

    // For `along`: the face (0 or 1) that lies on one side, its corner there, and which side that is.
    int lies_along = 0, corner = 0;
    bool before = false;

    Kind set(const PlacedFace& f, const PlacedFace& g) {
        for (int i = 0; i < 3; ++i) shared_[0][i] = shared_[1][i] = false;
        int shared = 0;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                if (f.vertex[i] == g.vertex[j]) shared_[0][i] = shared_[1][j] = true, ++shared;
        if (shared > 1) return Kind::none;
        const double size = std::max(f.coordinate, g.coordinate);
        const double tolerance =
            shared ? rounding_of_doubles * size : contact(std::max(f.spacing, g.spacing), size, size);
        const Side second_side = side(f, g, shared_[1], tolerance, distance_[1]);
        if (second_side == Side::one) return Kind::none;
        const Side first_side = side(g, f, shared_[0], tolerance, distance_[0]);
        if (first_side == Side::one || (first_side == Side::edge && second_side == Side::edge)) return Kind::none;
        Vec3 first[2], second[2];
        interval(f, distance_[0], first);
        interval(g, distance_[1], second);
        if (!overlap(first, second)) return Kind::none;
        if (first_side == Side::both && second_side == Side::both) return Kind::through;
        lies_along = first_side == Side::edge ? 0 : 1;
        const auto& distance = distance_[lies_along];
        corner = distance[0] != 0 ? 0 : distance[1] != 0 ? 1 : 2;
        before = distance[corner] > 0;
        return Kind::along;
    }

   private:
    // Says where the vertices of a face lie relative to a plane. `both` means on both sides. `edge` means on one side,
    // except a side of the face that lies in the plane. `one` means all others.
    enum class Side { both, edge, one };

    // Classifies the vertices of g relative to the plane of f. `distance` gets their distances times the length of the
    // normal, or 0 on the plane.
    static Side side(const PlacedFace& f, const PlacedFace& g, const bool (&shared)[3], double tolerance,
                     double (&distance)[3]) {
        int before = 0, behind = 0;
        for (int i = 0; i < 3; ++i) {
            distance[i] = 0;
            if (shared[i]) continue;
            const Vec3 from = g.p[i] - f.p[0];
            const double d = dot(f.normal, from);
            if (std::fabs(d) <= tolerance * f.normal_length ||
                std::fabs(d) <= rounding_of_triple_product(from, f.e1, f.e2))
                continue;
            distance[i] = d;
            ++(d > 0 ? before : behind);
        }
        return before && behind ? Side::both : before + behind == 1 ? Side::edge : Side::one;
    }

    // Finds where the triangle meets the plane: at a vertex, or where a side passes through.
    static void interval(const PlacedFace& f, const double (&distance)[3], Vec3 (&end)[2]) {
        int n = 0;
        for (int i = 0; i < 3; ++i) {
            const int j = i == 2 ? 0 : i + 1;
            if (distance[i] == 0) {
                end[n++] = f.p[i];
            } else if ((distance[i] > 0 && distance[j] < 0) || (distance[i] < 0 && distance[j] > 0)) {
                // Starting at the lower vertex gives the faces on both sides of an edge the same point.
                const bool low = f.vertex[i] < f.vertex[j];
                const int k = low ? i : j, l = low ? j : i;
                end[n++] = f.p[k] + (distance[k] / (distance[k] - distance[l])) * (f.p[l] - f.p[k]);
            }
        }
    }

    bool overlap(const Vec3 (&first)[2], const Vec3 (&second)[2]) {
        // The longer interval defines the direction, because nearly parallel planes determine it poorly.
        const Vec3 u = first[1] - first[0], v = second[1] - second[0];
        const Vec3 along = dot(u, u) > dot(v, v) ? u : v;
        const auto at = [&](Vec3 p) { return dot(p - first[0], along); };
        double f[2] = {0, at(first[1])}, g[2] = {at(second[0]), at(second[1])};
        const int f0 = f[1] < f[0], g0 = g[1] < g[0];
        const double begin = std::max(f[f0], g[g0]), end = std::min(f[1 - f0], g[1 - g0]);
        a = f[f0] > g[g0] ? first[f0] : second[g0];
        b = f[1 - f0] < g[1 - g0] ? first[1 - f0] : second[1 - g0];
        return begin < end;
    }

    bool shared_[2][3];      // marks of vertices of the other face
    double distance_[2][3];  // distances of the vertices from the other face's plane
};

}  // namespace edgegrad
