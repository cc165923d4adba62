// Samples textures at the coordinates of pixels: nearest, bilinear, and from mipmap pyramids.
#pragma once

#include <optional>

#include "core/array.h"
#include "core/parallel.h"
#include "raster/texels.h"
#include "raster/triangles.h"

namespace edgegrad {

enum class LookUp { nearest, linear, linear_nearest_level, linear_between_levels };

// Optional arrays may be null.
template <class T>
struct TextureInput {
    TextureShape shape;
    LookUp look_up;
    Frames frames;
    const T* texels;
    const T* uv;     // (pixels, 2), or 3 for a cube
    const T* uv_da;  // (pixels, 4), or 6: their derivatives in the image
    const T* bias;   // (pixels,) added to the level, or the level itself if uv_da is null

    int coordinates() const { return shape.boundary_mode == BoundaryMode::cube ? 3 : 2; }
};

// Returns (pixels, channels).
template <class T>
Array<T> sample_texture(const TextureInput<T>& in, ThreadTeam& team);

template <class T>
struct TextureGrad {
    std::optional<Array<T>> texels, uv, uv_da, bias;
};
struct TextureWanted {
    bool texels, uv, uv_da, bias;

    bool coordinates() const { return uv || uv_da || bias; }
};

// Returns the requested cotangents.
template <class T>
TextureGrad<T> sample_texture_vjp(const TextureInput<T>& in, const T* bar, TextureWanted wanted, ThreadTeam& team);

}  // namespace edgegrad
