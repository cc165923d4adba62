// Says how far touching things may lie apart because the input is rounded.
#pragma once

#include <limits>

namespace edgegrad {

// Returns this distance in world units: some spacings of the input's coordinates, plus roundings of doubles of that
// size.
inline constexpr double rounding_of_doubles = 64 * std::numeric_limits<double>::epsilon();
inline double contact(double spacing, double coordinate, double size) {
    return 8 * spacing * coordinate + rounding_of_doubles * size;
}

}  // namespace edgegrad
