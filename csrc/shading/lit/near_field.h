// Splits light that reaches the first point x₁ of a path into a near part, φ, and the rest, 1 − φ. With d = |x₂ − x₁|,
//
//     φ = (1 − d² / r²)² for d < r, else 0.
//
// As x₁ slides on its face with x₂ fixed, light changes by up to 1 / d, relatively. Next to corners, this derivative
// has infinite variance. The near part therefore uses finite differences instead, the near-field term
// (edgegrad/light/near_field.py). The derivatives of the rest are bounded by about 1 / r.
#pragma once

#include <algorithm>

#include "core/math.h"

namespace edgegrad {

class NearField {
   public:
    explicit NearField(double radius) : squared_(radius * radius) {}

    bool exists() const { return squared_ > 0; }
    // Returns φ for a displacement d = x₂ − x₁, and its derivative with respect to x₂.
    double share(Vec3 d) const { return exists() ? rest(d) * rest(d) : 0; }
    Vec3 slope(Vec3 d) const { return exists() ? (-4 * rest(d) / squared_) * d : Vec3{}; }

   private:
    double rest(Vec3 d) const { return std::max(0.0, 1 - dot(d, d) / squared_); }

    double squared_;
};

}  // namespace edgegrad
