// This file places the samples of a pixel, and makes their primary rays.
#pragma once

#include <cstdint>

#include "camera/camera.h"
#include "core/sampler.h"
#include "film/film.h"
#include "rays/camera_rays.h"

namespace edgegrad {

// Replaces n points of the unit square by normalised image coordinates of samples of pixel (x, y), drawn by the filter.
void place_in_pixel(const Camera& camera, const Filter& filter, int x, int y, int n, double* n_x, double* n_y);

// PixelRays makes the primary rays of the forward pass.
class PixelRays {
   public:
    PixelRays(const Camera& camera, const ImageOptions& o)
        : camera_(camera), filter_(o.filter), seed_(o.seed), lattice_(o.spp) {}

    // Appends the rays of samples first … first + n − 1 of pixel (x, y) to a batch.
    void append(int x, int y, int first, int n, CameraRays& rays) const;

   private:
    const Camera& camera_;
    Filter filter_;
    uint64_t seed_;
    ShiftedLattice lattice_;
};

}  // namespace edgegrad
