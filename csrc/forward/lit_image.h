// The image of a scene with materials in light, at one point for each face in a pixel, or several.
#pragma once

#include <cstdint>
#include <vector>

#include "core/array.h"
#include "forward/forward.h"
#include "shading/lit/lit.h"

namespace edgegrad {

// Random numbers of what is shaded, those of a pixel its own whatever the others see, so that the images of a scene and
// of one that is moved a little differ by little.
struct LitSampling {
    int points;            // of the samples of a pixel on one face, that are shaded
    uint64_t seed, again;  // of the first pass, and of pixels that are shaded again
};

// (H · W, C) before what lies behind the surfaces, and for each light whether a point asked for its shadow.
template <class T>
struct LitImage {
    Array<T> radiance;
    std::vector<uint8_t> asked;
};

// Pixels that borders of shadows or of nearest texels run through are shaded again, at several points
// (discontinuous_pixels.h).
template <class T>
LitImage<T> render_lit(const LitScene& lit, const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                       const ImageOptions& image, const LitOptions& options, const LitSampling& sampling,
                       ThreadTeam& team, const HitBuffers<T>& hits);

}  // namespace edgegrad
