// The accumulations of samples: reverse mode, forward mode, the gradient by places in the image, and the samples
// themselves, for whoever contracts them elsewhere (records.h). What each does with a sample inside a face stands in
// interior/accumulation.cpp, with one on a curve in boundary/accumulation.cpp.
#pragma once

#include <variant>

#include "accumulate/records.h"
#include "accumulate/tangent.h"

namespace edgegrad {

// To cotangents of the parameters; `geometry`: also of what moves inside faces.
struct Reverse {
    bool geometry;
};
// To derivatives of the pixels in several directions.
struct Forward {
    Directions directions;
};
// To the gradient by the places of what is seen, two numbers a pixel.
struct Screen {};

using Accumulation = std::variant<Reverse, Forward, Screen, Record>;

}  // namespace edgegrad
