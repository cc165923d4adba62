// This file relates the default samples of the gradient to those of the image.
#pragma once

#include <algorithm>

namespace edgegrad {

// The defaults of all terms are chosen at this number of samples per pixel.
constexpr double usual_spp = 16;

// Returns the factor on default samples. They grow with the samples of the image, so that the noise of both falls.
// Below the usual number the factor is 1, and the budget (budget.h) alone limits samples: fewer would save little time.
inline double sample_growth(int spp) { return std::max(1.0, spp / usual_spp); }

}  // namespace edgegrad
