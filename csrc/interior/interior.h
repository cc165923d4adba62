// This file declares the interior term ∫ Ã · ∂L/∂Φ dx: the change of the image inside the faces.
#pragma once

#include <optional>
#include <vector>

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

template <class T>
struct SurfaceMeasure;

// Adds the contribution of n samples on the measured surface, and of the pixel samples.
template <class T>
void add_interior(const BackwardView<T>& view, SurfaceMeasure<T>& surface, int64_t n, const Accumulation& accumulation,
                  GradientSink& to, BackwardProfile& profile);

// PixelSamples are `spp` samples in each of some pixels, on the faces marked in `faces` (F,), or on all if it is null.
struct PixelSamples {
    const std::vector<int64_t>& pixels;
    int spp;
    uint64_t seed;
    const uint8_t* faces;
    double share = 1;  // fraction of all pixels that `pixels` represents
    // If set, the pixels include this many beyond each side of the image, numbered row by row, and samples are uniform
    // in them. Otherwise samples are drawn in proportion to the filter of their pixel.
    std::optional<int> beyond = {};
    bool by_importance = false;  // whether pixels of more than mean importance get more samples
};
template <class T>
void add_pixel_samples(const BackwardView<T>& view, const PixelSamples& samples, const Accumulation& accumulation,
                       GradientSink& to, double (&seconds)[2]);

}  // namespace edgegrad
