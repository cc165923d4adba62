// Describes the faces of a cube around the eye, for lenses that see more than a half space. Each face has its own
// frame, in which it is a pinhole with |n.x|, |n.y| ≤ 1. Each direction belongs to one face.
#pragma once

#include <limits>
#include <optional>

#include "core/math.h"

namespace edgegrad {

// Holds a box of two coordinates.
struct Box2 {
    Vec2 low, high;

    static Box2 empty() {
        constexpr double infinite = std::numeric_limits<double>::infinity();
        return {{infinite, infinite}, {-infinite, -infinite}};
    }
    void add(Vec2 p);
};

// Returns the bounding box of r (sin λ, cos λ) for radii and angles between limits, at most 2 π apart.
Box2 sector_box(double inner, double outer, double from, double to);

// Describes one cube face. Directions d have a longitude λ = atan2(d.x, d.z) and a latitude φ = atan2(d.y, hypot(d.x,
// d.z)). Two faces look at the poles, where only d.y is not zero.
struct CubeFace {
    Mat3 rotation{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};  // rotates directions to this face's frame
    // Says whether all of its borders belong to it, or only that at the least n.x.
    bool closed = false;

    bool pole() const { return rotation.row[2].y != 0; }

    Vec3 direction(Vec2 n) const { return transposed_times(rotation, {n.x, n.y, 1}); }
    // Returns the n of a direction, if it belongs to this face.
    std::optional<Vec2> place(Vec3 d) const;
    // Returns how far a unit direction lies outside. Rotating it changes this by at most twice the angle.
    double outside(Vec3 d) const;

    // Bounds λ and φ over a box of n.
    Box2 angles(Box2 n) const;
    // Bounds n over this face's directions with λ and φ between two limits; none if there are none.
    std::optional<Box2> box(Vec2 from, Vec2 to) const;
};

// The faces look ahead, right, behind, left, below and above. Their rotations only exchange and negate axes, so faces
// agree on what lies between them.
constexpr int most_sides = 6;
constexpr CubeFace cube_faces[most_sides] = {
    {{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, false},   {{{{0, 0, -1}, {0, 1, 0}, {1, 0, 0}}}, false},
    {{{{-1, 0, 0}, {0, 1, 0}, {0, 0, -1}}}, false}, {{{{0, 0, 1}, {0, 1, 0}, {-1, 0, 0}}}, false},
    {{{{1, 0, 0}, {0, 0, -1}, {0, 1, 0}}}, true},   {{{{1, 0, 0}, {0, 0, 1}, {0, -1, 0}}}, true},
};

// Returns the distance of a box's farthest corner from the origin.
double farthest_radius(Box2 b);
Vec2 middle(Box2 b);

}  // namespace edgegrad
