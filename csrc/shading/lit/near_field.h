// Light that comes to the first point x₁ of a path from what is near, φ(d) of it with d = |x₂ − x₁|, and the rest, 1 −
// φ:
//
//     φ = (1 − d² / r²)² for d < r, else 0.
//
// As x₁ slides on its face with x₂ held on its own, light changes by up to 1 / d of it, and next to corners the
// variance of that is infinite. So of what is near no such derivatives are taken: it is compared at places that lie
// apart (edgegrad/light/near_field.py). Of the rest they are bounded by some 1 / r.
#pragma once

#include <algorithm>

#include "core/math.h"

namespace edgegrad {

class NearField {
   public:
    explicit NearField(double radius) : squared_(radius * radius) {}

    bool exists() const { return squared_ > 0; }
    // φ of a place at x₂ − x₁, and its derivative by x₂.
    double share(Vec3 d) const { return exists() ? rest(d) * rest(d) : 0; }
    Vec3 slope(Vec3 d) const { return exists() ? (-4 * rest(d) / squared_) * d : Vec3{}; }

   private:
    double rest(Vec3 d) const { return std::max(0.0, 1 - dot(d, d) / squared_); }

    double squared_;
};

}  // namespace edgegrad
