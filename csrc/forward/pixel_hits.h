// What the samples of an image hit, for shaders written in PyTorch.
//
// All samples of a pixel that hit the same face are one hit: it stands for them all, at one of them drawn at random, so
// that a shader is asked once for each face in a pixel and the mean over samples keeps its expected value.
#pragma once

#include <cstdint>
#include <vector>

#include "forward/forward.h"

namespace edgegrad {

// Arrays side by side, one entry or row for each hit.
struct PixelHits {
    std::vector<int32_t> pixel, face;
    std::vector<double> b;       // (N, 2) where on the face
    std::vector<double> x;       // (N, 2) pixel position
    std::vector<double> weight;  // the share of the pixel's samples
};

// Of the rows first … end − 1 of the image. Writes those rows of `out`, and marks the faces in it.
template <class T>
PixelHits find_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                          const ImageOptions& options, int first, int end, Team& team, const HitBuffers<T>& out);

}  // namespace edgegrad
