// How much the interior term is to look at each face, and what it knows of faces without a sample.
#pragma once

#include <cstdint>
#include <vector>

#include "interior.h"

namespace edgegrad {

// Triangles are laid end to end by the measure m = (area + longest side · 1 px) · (how much the loss looks there), in
// image units, clipped to the view; more where there is a texture, less where the forward pass saw nothing or where a
// control (control.h) says nearly all.
template <class T>
struct SurfaceMeasure {
    Array<double> of_face;           // (F,) m
    Array<uint8_t> is_controlled;    // (F,)
    Array<T> adjoint;                // (V, C) Ã at the vertices of faces with a control
    std::vector<uint8_t> is_large;   // (F,) faces left to samples of the pixels; empty without textures
    std::vector<int64_t> pixels;     // which those may touch
    double total = 0, of_large = 0;  // default samples: of the faces laid out, of the large ones
};

// Looks at all faces, and adds to `to` what the controls of whole faces are.
template <int N, class T>
SurfaceMeasure<T> measure_surface(const BackwardView<T>& view, bool geometry, Destination& to);

}  // namespace edgegrad
