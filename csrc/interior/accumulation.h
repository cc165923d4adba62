// This file declares what becomes of a sample inside a face. In reverse mode it adds a cotangent of the face's data
// (face_grad.h), in forward mode a derivative of the pixels around it. In screen space it adds that by image position.
#pragma once

#include <cstdint>
#include <memory>

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

// A SurfaceSample lies at u in the undistorted image, with barycentrics λ, and stands for a share of the face's area.
// It is seen at x, where it stands for `weight` px².
struct SurfaceSample {
    int32_t face;
    bool controlled;
    Vec2 u, x;
    Barycentrics lambda;
    double share, weight;
    Vec2 across = {};  // px across a narrow face, as long as the error of rays; 0: the face is wide
};

// SurfaceAccumulation is compiled once per type of image and number of channels; samplers depend on neither.
class SurfaceAccumulation {
   public:
    virtual ~SurfaceAccumulation() = default;

    // Returns false if a sample cannot contribute. i identifies it in its batch.
    virtual bool wants(int i, const SurfaceSample& sample) = 0;
    // Adds a sample for which wants() returned true, seen at n.
    virtual void add(int i, const SurfaceSample& sample, Vec2 n, bool visible) = 0;

    // Starts samples drawn in a pixel, with this weight each. Returns false if they cannot contribute.
    virtual bool begin_pixel(int64_t pixel, double weight) = 0;
    virtual void add_in_pixel(int32_t face, Vec2 n, Vec2 x) = 0;

    virtual void finish() = 0;
};

// Makes the accumulation of one chunk of samples.
template <class T>
std::unique_ptr<SurfaceAccumulation> accumulate_surfaces(const BackwardView<T>& view, const Accumulation& accumulation,
                                                         const GradientSink& to, LocalGradients& grad);

}  // namespace edgegrad
