// Holds triangles in clip space for a batch of images. In instanced mode, each image has its own vertices and the same
// triangles. In range mode, all share the vertices, and each has a range of the triangles.
#pragma once

#include <cstdint>

#include "core/math.h"

namespace edgegrad {

// Describes a batch of images, with row 0 at the bottom.
struct Frames {
    int64_t count, height, width;

    int64_t pixels() const { return count * height * width; }
    // These return the centre of a pixel in normalized device coordinates.
    double x(int64_t column) const { return double(2 * column + 1 - width) / double(width); }
    double y(int64_t row) const { return double(2 * row + 1 - height) / double(height); }
    // Returns the centre times width · height, which is exact.
    Vec3 exact_center(int64_t column, int64_t row) const {
        return {double(2 * column + 1 - width) * double(height), double(2 * row + 1 - height) * double(width),
                double(width) * double(height)};
    }
};

template <class T>
struct Triangles {
    const T* pos;  // (vertices, 4), or (count, vertices, 4): x, y, z, w
    int64_t vertices;
    bool shared;         // All images share the vertices.
    const int32_t* tri;  // (triangles, 3)
    int64_t triangles;
    const int32_t* ranges;  // (count, 2): first and count; null: all of them

    int64_t first(int64_t item) const { return ranges ? ranges[2 * item] : 0; }
    int64_t end(int64_t item) const { return ranges ? int64_t(ranges[2 * item]) + ranges[2 * item + 1] : triangles; }
    const T* vertex(int64_t item, int64_t v) const { return pos + 4 * (v + (shared ? 0 : item * vertices)); }
    // Returns a homogeneous point of the image: x, y, w.
    Vec3 in_image(int64_t item, int64_t v) const {
        const T* p = vertex(item, v);
        return {double(p[0]), double(p[1]), double(p[3])};
    }
};

// Holds a rasterizer's output at one pixel: u, v, z/w, triangle + 1.
template <class T>
struct RasterPixel {
    double u, v, depth;
    int64_t triangle;  // −1 means none.

    explicit RasterPixel(const T* four) : u(four[0]), v(four[1]), depth(four[2]), triangle(int64_t(four[3]) - 1) {}
};

}  // namespace edgegrad
