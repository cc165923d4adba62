// A side of a cube around the eye, for lenses that see more than a half space: each has a frame of its own, in which it
// is a pinhole with |n.x|, |n.y| ≤ 1, and each direction has one side.
#pragma once

#include <limits>
#include <optional>

#include "core/math.h"

namespace edgegrad {

// A box of two coordinates.
struct Box2 {
    Vec2 low, high;

    static Box2 empty() {
        constexpr double infinite = std::numeric_limits<double>::infinity();
        return {{infinite, infinite}, {-infinite, -infinite}};
    }
    void add(Vec2 p);
};

// What r (sin λ, cos λ) takes up for radii and angles between two; there are no more than 2 π between these.
Box2 sector_box(double inner, double outer, double from, double to);

// Directions d have a longitude λ = atan2(d.x, d.z) and a latitude φ = atan2(d.y, hypot(d.x, d.z)); two sides look at
// the poles, where d.y is all.
struct CubeFace {
    Mat3 turn{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};  // of directions to this side's frame
    // Which of its borders are its own: all, or only that at the least n.x.
    bool closed = false;

    bool pole() const { return turn.row[2].y != 0; }

    Vec3 direction(Vec2 n) const { return transposed_times(turn, {n.x, n.y, 1}); }
    // The n of a direction, if it belongs to this side.
    std::optional<Vec2> place(Vec3 d) const;
    // By how much a direction of length one lies outside: it changes by no more than twice what that turns by.
    double outside(Vec3 d) const;

    // λ and φ over a box of n.
    Box2 angles(Box2 n) const;
    // The box of n of all directions of this side with λ and φ between two; none if there are none.
    std::optional<Box2> box(Vec2 from, Vec2 to) const;
};

// Ahead, right, behind, left; below, above. Signs and exchanges alone, so that sides agree on what lies between them.
constexpr int most_sides = 6;
constexpr CubeFace cube_faces[most_sides] = {
    {{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, false},   {{{{0, 0, -1}, {0, 1, 0}, {1, 0, 0}}}, false},
    {{{{-1, 0, 0}, {0, 1, 0}, {0, 0, -1}}}, false}, {{{{0, 0, 1}, {0, 1, 0}, {-1, 0, 0}}}, false},
    {{{{1, 0, 0}, {0, 0, -1}, {0, 1, 0}}}, true},   {{{{1, 0, 0}, {0, 0, 1}, {0, -1, 0}}}, true},
};

// Of the corner of a box that is farthest from the origin.
double farthest_radius(Box2 b);
Vec2 middle(Box2 b);

}  // namespace edgegrad
