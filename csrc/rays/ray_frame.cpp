#include "rays/ray_frame.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdio>
#include <limits>
#include <stdexcept>

#include "core/array.h"

namespace edgegrad {

// Returns the frame in which Embree sees the scene.
//
// Its origin is where the detail is: the mean of the faces' centroids weighted with 1 / (longest side)². Floats are
// finest near the origin, so a small object on a wide ground plane keeps its shape.
//
// Its unit matters only where the scene spans many powers of ten, because floats round equally at any scale. Embree
// takes products of three lengths, which must not leave the range of floats, 1e-38 … 1e38. If the farthest vertex lies
// very many face sizes away, the unit is chosen between. The face size (the geometric mean) then lies as far below the
// unit as that vertex lies above it.
RayFrame frame_of(const PlacedTriangles& triangles, ThreadTeam& team) {
    const auto& [faces, n_faces, verts, n_verts, used] = triangles;
    const auto vertex = [&](int64_t v) { return Vec3{verts[3 * v], verts[3 * v + 1], verts[3 * v + 2]}; };
    const Vec3 base = vertex(faces[0]);
    struct Block {
        Vec3 sum;
        double weight = 0;
        int64_t faces = 0, powers = 0;  // number of faces with a side, and sum of log₂ of the sides' squares
    };
    const auto of_faces = team.map_blocks(n_faces, [&](int64_t first, int64_t last) {
        Block block;
        for (int64_t f = first; f < last; ++f) {
            if (constexpr int ahead = 16; f + ahead < last)
                for (int i = 0; i < 3; ++i) prefetch(verts + 3 * int64_t(faces[3 * (f + ahead) + i]));
            const Vec3 a = vertex(faces[3 * f]), b = vertex(faces[3 * f + 1]), c = vertex(faces[3 * f + 2]);
            const double side = std::max({dot(b - a, b - a), dot(c - b, c - b), dot(a - c, a - c)});
            if (side > 0) ++block.faces, block.powers += int64_t(std::bit_cast<uint64_t>(side) >> 52) - 1023;
            double w = 1 / side;
            if (!(w <= std::numeric_limits<double>::max())) w = 0;  // The face is a single point.
            block.weight += w;
            block.sum += w * (a - base + (b - base) + (c - base));
        }
        block.sum = (1.0 / 3) * block.sum;
        return block;
    });
    Block all;
    for (const Block& b : of_faces)
        all.sum += b.sum, all.weight += b.weight, all.faces += b.faces, all.powers += b.powers;
    RayFrame frame;
    auto& [centre, unit, radius] = frame;
    centre = base + (1 / all.weight) * all.sum;
    if (!std::isfinite(centre.x + centre.y + centre.z)) centre = base;

    const Vec3 from = centre;
    const std::vector<double> farthest = team.map_blocks(n_verts, [&](int64_t first, int64_t last) {
        double most = 0;
        for (int64_t v = first; v < last; ++v) {
            if (!(used.empty() || used[v])) continue;
            const Vec3 p = vertex(v) - from;
            most = std::max(most, dot(p, p));
        }
        return most;
    });
    unit = std::sqrt(*std::max_element(farthest.begin(), farthest.end())), radius = 1;
    if (!(unit > 0)) unit = 1;  // The scene is a single point.
    if (!all.faces) return frame;
    constexpr int ordinary_span = 20, most_span = 70, most_of_radius = 36;  // powers of two
    const double size = double(all.powers) / (2 * double(all.faces)), span = std::log2(unit) - size;
    if (span > most_span) {
        char text[256];
        std::snprintf(text, sizeof text,
                      "verts: expected faces within 1e21 times their size of each other, got a vertex %.1e away from "
                      "faces of about %.1e; leave out what is so far or bring it nearer",
                      unit, std::exp2(size));
        throw std::invalid_argument(text);
    }
    if (span <= ordinary_span) return frame;
    radius = std::exp2(std::min(int(span / 2), most_of_radius));
    unit /= radius;
    return frame;
}

}  // namespace edgegrad
