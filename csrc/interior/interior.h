// The interior term ∫ Ã · ∂L/∂Φ dx: what changes inside the faces.
#pragma once

#include <optional>
#include <vector>

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

template <class T>
struct SurfaceMeasure;

// Adds what n samples find on the measured surface, and those of the pixels.
template <class T>
void add_interior(const BackwardView<T>& view, SurfaceMeasure<T>& surface, int64_t n, const Accumulation& accumulation,
                  GradientSink& to, BackwardProfile& profile);

// So many samples in each of some pixels, on the faces marked in `faces` (F,), or on all if it is null.
struct PixelSamples {
    const std::vector<int64_t>& pixels;
    int spp;
    uint64_t seed;
    const uint8_t* faces;
    double share = 1;  // of the pixels of which these are some
    // If there are some, the pixels are those of the plane, row by row, so many beyond each side of the image included,
    // and samples are uniform in them; else these are drawn in proportion to the filter of their pixel.
    std::optional<int> beyond = {};
    bool by_importance = false;  // a pixel that counts more than the mean gets more samples
};
template <class T>
void add_pixel_samples(const BackwardView<T>& view, const PixelSamples& samples, const Accumulation& accumulation,
                       GradientSink& to, double (&seconds)[2]);

}  // namespace edgegrad
