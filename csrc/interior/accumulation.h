// What becomes of a sample inside a face: in reverse mode a cotangent of what the face is made of (face_grad.h), in
// forward mode a derivative of the pixels around it, or the gradient by its place in the image.
#pragma once

#include <cstdint>
#include <memory>

#include "accumulate/accumulation.h"
#include "estimator/view.h"

namespace edgegrad {

// A sample at u in the undistorted image, with barycentrics λ there, that stands for a share of the face's area; it is
// seen at x, where `weight` px² are its own.
struct SurfaceSample {
    int32_t face;
    bool controlled;
    Vec2 u, x;
    Barycentrics lambda;
    double share, weight;
    Vec2 across = {};  // a narrow face, by as much as rays err, px; 0: it is wide
};

// Accumulations are compiled once for each type of image and number of channels, what draws the samples without either.
class SurfaceAccumulation {
   public:
    virtual ~SurfaceAccumulation() = default;

    // False if nothing could come of a sample; i tells those of a batch apart.
    virtual bool wants(int i, const SurfaceSample& sample) = 0;
    // One that it wanted, seen at n.
    virtual void add(int i, const SurfaceSample& sample, Vec2 n, bool visible) = 0;

    // Samples that were drawn in a pixel, with this weight each. False if nothing could come of them.
    virtual bool begin_pixel(int64_t pixel, double weight) = 0;
    virtual void add_in_pixel(int32_t face, Vec2 n, Vec2 x) = 0;

    virtual void finish() = 0;
};

// Of the samples of one chunk.
template <class T>
std::unique_ptr<SurfaceAccumulation> accumulate_surfaces(const BackwardView<T>& view, const Accumulation& accumulation,
                                                         const GradientSink& to, LocalGradients& grad);

}  // namespace edgegrad
