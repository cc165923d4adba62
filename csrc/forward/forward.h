// The image.
#pragma once

#include <cstdint>

#include "camera/camera.h"
#include "camera/camera_rays.h"
#include "core/parallel.h"
#include "core/sampler.h"
#include "film/film.h"
#include "scene/scene.h"

namespace edgegrad {

struct ImageOptions {
    int spp;  // samples a pixel
    Filter filter;
    uint64_t seed;
};

// Of points of the unit square, in place: where rays through pixel (x, y) go, drawn in proportion to the filter.
void place_in_pixel(const Camera& camera, const Filter& filter, int x, int y, int n, double* n_x, double* n_y);

// The rays of the forward pass: samples first … first + n − 1 of pixel (x, y), appended to a batch.
class PixelRays {
   public:
    PixelRays(const Camera& camera, const ImageOptions& o)
        : camera_(camera), filter_(o.filter), seed_(o.seed), lattice_(o.spp) {}

    void append(int x, int y, int first, int n, CameraRays& rays) const;

   private:
    const Camera& camera_;
    Filter filter_;
    uint64_t seed_;
    ShiftedLattice lattice_;
};

// What the image pass hit, for the backward pass.
template <class T>
struct HitBuffers {
    T* coverage = nullptr;    // (H, W): the filtered share of each pixel where something is hit
    float* depth = nullptr;   // (H, W): nothing that samples hit lies farther away; infinite where one hit nothing
    int32_t* hit = nullptr;   // (H, W, 2): the first and the last of the faces hit, as the scene counts them; −1: none
    uint8_t* seen = nullptr;  // (F,): 0, or the side, 1 or 2, from which a sample hit the face
};

// Writes `image` (H, W, C) and `hits`.
template <class T>
void render_forward(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                    const ImageOptions& options, Team& team, T* image, const HitBuffers<T>& hits);

}  // namespace edgegrad
