// How far what touches may lie apart by the rounding of the input.
#pragma once

#include <limits>

namespace edgegrad {

// World units by which what touches may lie apart: some spacings of the input's coordinates, and what doubles leave of
// a thing of that size.
inline constexpr double rounding_of_doubles = 64 * std::numeric_limits<double>::epsilon();
inline double contact(double spacing, double coordinate, double size) {
    return 8 * spacing * coordinate + rounding_of_doubles * size;
}

}  // namespace edgegrad
