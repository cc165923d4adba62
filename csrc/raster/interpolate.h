// Interpolates vertex attributes at the surface points that a rasterizer found.
#pragma once

#include <optional>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "raster/triangles.h"

namespace edgegrad {

template <class T>
struct VertexAttributes {
    const T* values;  // (vertices, width), or (images, vertices, width)
    int64_t vertices;
    int width;
    bool shared;  // All images share them.

    const T* row(int64_t item, int64_t v) const { return values + (v + (shared ? 0 : item * vertices)) * width; }
};

template <class T>
struct RasterView {
    Frames frames;
    const int32_t* tri;  // (triangles, 3)
    int64_t triangles;
    const T* rast;     // (count, height, width, 4)
    const T* rast_db;  // (count, height, width, 4), or null
};

template <class T>
struct Interpolated {
    Array<T> values;  // (count, height, width, width of attributes)
    Array<T> da;      // (count, height, width, 2 × chosen): ∂a/∂X, ∂a/∂Y of each
};

// Interpolates attributes; `chosen` lists those that also need derivatives in the image.
template <class T>
Interpolated<T> interpolate(const VertexAttributes<T>& attr, const RasterView<T>& at, const std::vector<int>& chosen,
                            ThreadTeam& team);

template <class T>
struct InterpolateGrad {
    std::optional<Array<T>> attr, rast, rast_db;
};
struct InterpolateWanted {
    bool attr, rast, rast_db;
};

// Returns the requested cotangents, each with the shape of its input. `da_bar` may be null.
template <class T>
InterpolateGrad<T> interpolate_vjp(const VertexAttributes<T>& attr, const RasterView<T>& at,
                                   const std::vector<int>& chosen, const T* bar, const T* da_bar,
                                   InterpolateWanted wanted, ThreadTeam& team);

}  // namespace edgegrad
