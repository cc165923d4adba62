// Lists what the samples of an image hit, for shaders written in PyTorch.
//
// All samples of a pixel that hit the same face are one hit, at one of them drawn at random. A shader runs once for
// each face in a pixel, and the mean over samples keeps its expected value. On request, several samples represent all.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "camera/face_map.h"
#include "core/array.h"
#include "forward/forward.h"

namespace edgegrad {

// Holds the change of barycentrics one pixel to the right, and one down.
struct Spread {
    Barycentrics right, down;
};

struct PixelHit {
    int32_t pixel, face;
    Barycentrics b;  // place of the hit on the face
    Vec2 x;          // pixel position
    double weight;   // fraction of the pixel's samples
    Spread spread;   // set on request
};

// Holds arrays with one entry or row per hit.
struct PixelHits {
    explicit PixelHits(int64_t size) : pixel(size), face(size), b(2 * size), x(2 * size), weight(size) {}

    Array<int32_t> pixel, face;
    Array<double> b, x;  // (N, 2)
    Array<double> weight;
};

// Selects hits in the rows first … end − 1 of an image.
struct PixelChoice {
    int first, end;
    int most = 1;                   // This many samples per pixel and face represent all of them.
    const uint8_t* only = nullptr;  // (H, W) selects pixels; null: all.
    bool spread = false;            // requests the spread
};

// Receives the hits of rows, one row after another. Hits of one pixel are consecutive, but may come in several parts
// where a lens has several sub-cameras.
class RowVisitor {
   public:
    virtual ~RowVisitor() = default;
    virtual void visit(int y, std::vector<PixelHit>& hits) = 0;
};
using MakeVisitor = std::function<std::unique_ptr<RowVisitor>()>;  // Each thread calls it once.

// Visits the hits of all pixels, writes their rows of `out`, and marks the faces in it. For selected pixels, it writes
// nothing, and draws the representative samples independently of the draw for all pixels.
template <class T>
void visit_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                      const ImageOptions& options, const PixelChoice& choice, ThreadTeam& team,
                      const HitBuffers<T>& out, const MakeVisitor& make);

// Does the same, and returns arrays.
template <class T>
PixelHits find_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                          const ImageOptions& options, const PixelChoice& choice, ThreadTeam& team,
                          const HitBuffers<T>& out);

}  // namespace edgegrad
