// An image and its means over squares of 2, 4, 8 … texels (Williams 1983), level after level, each row by row. A level
// is half as high and wide as the one before, rounded down; where that was odd, means are over windows that overlap.
#pragma once

#include <cstdint>

#include "core/array.h"
#include "core/parallel.h"
#include "texture/texture.h"

namespace edgegrad {

// Of an image whose texels lie from the first row on.
struct PyramidShape {
    TexelGrid image;
    int channels;

    int levels() const;
    int64_t texels() const;
};

// (texels, channels)
template <class T>
Array<T> pyramid(const PyramidShape& shape, const T* image, ThreadTeam& team);
// The cotangent of the image, from that of the pyramid.
template <class T>
Array<T> pyramid_vjp(const PyramidShape& shape, const T* bar, ThreadTeam& team);

}  // namespace edgegrad
