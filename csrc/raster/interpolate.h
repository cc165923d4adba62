// Attributes of vertices at the surface points that a rasterizer found.
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
    bool shared;  // by all images

    const T* row(int64_t item, int64_t v) const { return values + (v + (shared ? 0 : item * vertices)) * width; }
};

template <class T>
struct RasterView {
    Frames frames;
    const int32_t* tri;  // (triangles, 3)
    int64_t triangles;
    const T* rast;     // (count, height, width, 4)
    const T* rast_db;  // the same; null where there is none
};

template <class T>
struct Interpolated {
    Array<T> values;  // (count, height, width, width of attributes)
    Array<T> da;      // (count, height, width, 2 × chosen): ∂a/∂X, ∂a/∂Y of each
};

// `chosen`: of which attributes derivatives in the image are wanted.
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

// The cotangents that are wanted, each of the shape of what it belongs to. `da_bar` may be null.
template <class T>
InterpolateGrad<T> interpolate_vjp(const VertexAttributes<T>& attr, const RasterView<T>& at,
                                   const std::vector<int>& chosen, const T* bar, const T* da_bar,
                                   InterpolateWanted wanted, ThreadTeam& team);

}  // namespace edgegrad
