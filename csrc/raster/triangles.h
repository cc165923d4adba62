// Triangles in clip space, for a batch of images: each with vertices of its own and the same triangles (instanced
// mode), or all with the same vertices and each with a range of the triangles (range mode).
#pragma once

#include <cstdint>

#include "core/math.h"

namespace edgegrad {

// Of one batch of images, row 0 at the bottom.
struct Frames {
    int64_t count, height, width;

    int64_t pixels() const { return count * height * width; }
    // The centre of a pixel in normalized device coordinates.
    double x(int64_t column) const { return double(2 * column + 1 - width) / double(width); }
    double y(int64_t row) const { return double(2 * row + 1 - height) / double(height); }
    // The same times width · height, which no rounding touches.
    Vec3 exact_center(int64_t column, int64_t row) const {
        return {double(2 * column + 1 - width) * double(height), double(2 * row + 1 - height) * double(width),
                double(width) * double(height)};
    }
};

template <class T>
struct Triangles {
    const T* pos;  // (vertices, 4), or (count, vertices, 4): x, y, z, w
    int64_t vertices;
    bool shared;         // the vertices, by all images
    const int32_t* tri;  // (triangles, 3)
    int64_t triangles;
    const int32_t* ranges;  // (count, 2): first and how many; null: all of them

    int64_t first(int64_t item) const { return ranges ? ranges[2 * item] : 0; }
    int64_t end(int64_t item) const { return ranges ? int64_t(ranges[2 * item]) + ranges[2 * item + 1] : triangles; }
    const T* vertex(int64_t item, int64_t v) const { return pos + 4 * (v + (shared ? 0 : item * vertices)); }
    // As points of the image, homogeneous: x, y, w.
    Vec3 in_image(int64_t item, int64_t v) const {
        const T* p = vertex(item, v);
        return {double(p[0]), double(p[1]), double(p[3])};
    }
};

// What a rasterizer's output says of one pixel: u, v, z/w, triangle + 1.
template <class T>
struct RasterPixel {
    double u, v, depth;
    int64_t triangle;  // −1: none

    explicit RasterPixel(const T* four) : u(four[0]), v(four[1]), depth(four[2]), triangle(int64_t(four[3]) - 1) {}
};

}  // namespace edgegrad
