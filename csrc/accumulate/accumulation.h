// Lists the accumulations of samples: reverse mode, forward mode, the screen-space gradient, and recorded samples for
// differentiation elsewhere (records.h). interior/accumulation.cpp applies them to samples inside faces,
// boundary/accumulation.cpp to samples on curves.
#pragma once

#include <variant>

#include "accumulate/records.h"
#include "accumulate/tangent.h"

namespace edgegrad {

// Accumulates the adjoint: cotangents of the parameters. `geometry` includes what moves inside faces.
struct Reverse {
    bool geometry;
};
// Accumulates tangents: derivatives of the pixels in several directions.
struct Forward {
    Directions directions;
};
// Accumulates the gradient with respect to image positions, two numbers a pixel.
struct Screen {};

using Accumulation = std::variant<Reverse, Forward, Screen, Record>;

}  // namespace edgegrad
