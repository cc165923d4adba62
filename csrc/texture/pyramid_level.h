// Selects the levels of a pyramid (pyramid.h) by a continuous level, between which values are interpolated.
#pragma once

#include "core/dual.h"

namespace edgegrad {

template <class S>
struct PyramidLevel {
    int fine = 0;
    S share = 0;  // weight of the next coarser level
    // Says whether it lies between two levels. Otherwise it is the finest or the coarsest one, without a derivative.
    bool is_between = false;

    PyramidLevel() = default;
    // Level 0 is the image; NaN selects it, too. `levels` counts all levels.
    PyramidLevel(S level, int levels) {
        if (plain(level) >= levels - 1) {
            fine = levels - 1;
        } else if (plain(level) > 0) {
            fine = int(plain(level)), share = level - S(double(fine)), is_between = true;
        }
    }

    // Calls visit(level, its weight); for both levels where the weight has a derivative.
    template <class Visit>
    void each(Visit visit) const {
        visit(fine, S(1) - share);
        if (is_between) visit(fine + 1, share);
    }
};

}  // namespace edgegrad
