// This file declares each face's sampling density in the interior term, and what it knows without a sample.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "estimator/view.h"

namespace edgegrad {

// Triangles lie end to end by the measure m = (area + longest side · 1 px) · (importance of the adjoint there). It is
// in image units and clipped to the view. It is larger for textures. It is smaller where the forward pass hit nothing,
// or where a control (control.h) covers nearly all.
template <class T>
struct SurfaceMeasure {
    Array<double> of_face;            // (F,) m
    Array<uint8_t> is_controlled;     // (F,)
    std::vector<uint8_t> by_pixels;   // (F,) faces left to samples of the pixels; empty: none
    std::vector<int64_t> pixels;      // pixels that those may touch, or a subset
    double pixel_share = 1;           // fraction of these pixels in the subset
    int pixel_spp = 0;                // samples in each
    int beyond = 0;                   // number of pixels beyond each side of the image that count, see PixelSamples
    double total = 0, of_pixels = 0;  // default samples: of the faces laid end to end, of those left to the pixels

    // Returns the factor on the default samples that gives `given`, or 1. A panorama's sub-camera may see no face.
    double scale(int64_t given) const {
        const double all = total + of_pixels;
        return given >= 0 && all > 0 ? double(given) / all : 1;
    }
    // Returns the samples on the faces that are laid end to end.
    int64_t wanted(int64_t given) const {
        if (!(total > 0)) return 0;
        return given >= 0 ? std::max(1ll, std::llround(scale(given) * total)) : int64_t(std::ceil(total));
    }
    int64_t pixel_samples() const { return pixel_spp * int64_t(pixels.size()); }
};

// Measures all faces, and adds to `to` the integrals of the controls. Writes Camera::facing of each face into `facing`
// (F,), unless that is empty.
template <class T>
SurfaceMeasure<T> measure_surface(const BackwardView<T>& view, bool geometry, Array<int8_t>& facing, GradientSink& to);

}  // namespace edgegrad
