// The interior term ∫ Ã · ∂L/∂Φ dx: what changes inside the faces.
#pragma once

#include <vector>

#include "backward/view.h"

namespace edgegrad {

template <class T>
struct SurfaceMeasure;

// Adds what n samples find on the measured surface, and those of the pixels; `geometry` says whether points and camera
// are wanted too.
template <int N, class T>
void add_interior(const BackwardView<T>& view, SurfaceMeasure<T>& surface, int64_t n, bool geometry, Destination& to,
                  BackwardProfile& profile);

// Adds what `spp` samples in each of some pixels find on the faces marked in `faces` (F,), or on all if it is null.
template <int N, class T>
void add_pixel_samples(const BackwardView<T>& view, const std::vector<int64_t>& pixels, int spp, uint64_t seed,
                       const uint8_t* faces, bool geometry, Destination& to, double (&seconds)[2]);

}  // namespace edgegrad
