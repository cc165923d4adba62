// How much the interior term is to look at each face, and what it knows of faces without a sample.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "estimator/view.h"

namespace edgegrad {

// Triangles are laid end to end by the measure m = (area + longest side · 1 px) · (the importance of the adjoint
// there), in image units, clipped to the view; more where there is a texture, less where the forward pass saw nothing
// or where a control (control.h) says nearly all.
template <class T>
struct SurfaceMeasure {
    Array<double> of_face;            // (F,) m
    Array<uint8_t> is_controlled;     // (F,)
    std::vector<uint8_t> by_pixels;   // (F,) faces left to samples of the pixels; empty if there are none
    std::vector<int64_t> pixels;      // which those may touch, or some of these
    double pixel_share = 1;           // how many of them
    int pixel_spp = 0;                // samples in each
    int beyond = 0;                   // so many pixels beyond each side of the image count, see PixelSamples
    double total = 0, of_pixels = 0;  // default samples: of the faces laid out, of those left to the pixels

    // How often each is sampled: as the defaults, or in proportion to them if a number is given. A side of a panorama
    // may see no face at all.
    double scale(int64_t given) const {
        const double all = total + of_pixels;
        return given >= 0 && all > 0 ? double(given) / all : 1;
    }
    // Samples on the faces that are laid out.
    int64_t wanted(int64_t given) const {
        if (!(total > 0)) return 0;
        return given >= 0 ? std::max(1ll, std::llround(scale(given) * total)) : int64_t(std::ceil(total));
    }
    int64_t pixel_samples() const { return pixel_spp * int64_t(pixels.size()); }
};

// Measures all faces, and adds to `to` the integrals of the controls. What it finds of their orientation in the image
// it writes into `facing` (F,), as Camera::facing has it, unless that is empty.
template <class T>
SurfaceMeasure<T> measure_surface(const BackwardView<T>& view, bool geometry, Array<int8_t>& facing, GradientSink& to);

}  // namespace edgegrad
