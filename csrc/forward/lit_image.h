// Renders the image of a lit scene with materials, at one or several points for each face in a pixel.
#pragma once

#include <cstdint>
#include <vector>

#include "core/array.h"
#include "forward/forward.h"
#include "shading/lit/lit.h"

namespace edgegrad {

// Controls sampling. The random numbers of a pixel do not depend on what others see, so images of slightly different
// scenes differ slightly.
struct LitSampling {
    int points;            // number of shaded points per face and pixel
    uint64_t seed, again;  // for the first pass, and for pixels that are shaded again
};

// Holds the radiance (H · W, C) without the background, and whether some point needs each light's shadow.
template <class T>
struct LitImage {
    Array<T> radiance;
    std::vector<uint8_t> shadow_needed;
};

// Shades pixels with shadow boundaries or texel edges again, at several points (discontinuous_pixels.h).
template <class T>
LitImage<T> render_lit(const LitScene& lit, const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                       const ImageOptions& image, const LitOptions& options, const LitSampling& sampling,
                       ThreadTeam& team, const HitBuffers<T>& hits);

}  // namespace edgegrad
