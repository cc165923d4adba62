// Builds mipmap pyramids: an image and its means over squares of 2, 4, 8 … texels (Williams 1983), level after level,
// row by row. A level is half as high and wide as the one before, rounded down. Odd sizes use overlapping windows.
#pragma once

#include <cstdint>

#include "core/array.h"
#include "core/parallel.h"
#include "texture/texture.h"

namespace edgegrad {

// Describes the pyramid of an image whose texels begin at the first row.
struct PyramidShape {
    TexelGrid image;
    int channels;

    int levels() const;
    int64_t texels() const;
};

// Returns (texels, channels).
template <class T>
Array<T> pyramid(const PyramidShape& shape, const T* image, ThreadTeam& team);
// Returns the cotangent of the image from that of the pyramid.
template <class T>
Array<T> pyramid_vjp(const PyramidShape& shape, const T* bar, ThreadTeam& team);

}  // namespace edgegrad
