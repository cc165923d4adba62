// What the samples of an image hit, for shaders written in PyTorch.
//
// All samples of a pixel that hit the same face are one hit: it stands for them all, at one of them drawn at random, so
// that a shader is asked once for each face in a pixel and the mean over samples keeps its expected value. Where more
// are wanted, several of them stand for all.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "camera/face_map.h"
#include "core/array.h"
#include "forward/forward.h"

namespace edgegrad {

// How far barycentrics are apart one pixel to the right, and one down.
struct Spread {
    Barycentrics right, down;
};

struct PixelHit {
    int32_t pixel, face;
    Barycentrics b;  // where on the face
    Vec2 x;          // pixel position
    double weight;   // the share of the pixel's samples
    Spread spread;   // where it is wanted
};

// Arrays side by side, one entry or row for each hit.
struct PixelHits {
    explicit PixelHits(int64_t size) : pixel(size), face(size), b(2 * size), x(2 * size), weight(size) {}

    Array<int32_t> pixel, face;
    Array<double> b, x;  // (N, 2)
    Array<double> weight;
};

// Which hits, of the rows first … end − 1 of an image.
struct PixelChoice {
    int first, end;
    int most = 1;                   // of the samples of a pixel on one face that stand for all of them
    const uint8_t* only = nullptr;  // (H, W): the pixels; null: all
    bool spread = false;            // whether it is wanted
};

// Is given the hits of rows, one row after another. Those of one pixel follow one another, but where a lens is looked
// through side by side they may come in several parts.
class RowVisitor {
   public:
    virtual ~RowVisitor() = default;
    virtual void visit(int y, std::vector<PixelHit>& hits) = 0;
};
using MakeVisitor = std::function<std::unique_ptr<RowVisitor>()>;  // one for each thread

// Of all pixels; writes their rows of `out`, and marks the faces in it. Of some pixels it writes nothing, and which of
// their samples stand for all is drawn independently of the draw for all pixels.
template <class T>
void visit_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                      const ImageOptions& options, const PixelChoice& choice, ThreadTeam& team,
                      const HitBuffers<T>& out, const MakeVisitor& make);

// The same, as arrays.
template <class T>
PixelHits find_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                          const ImageOptions& options, const PixelChoice& choice, ThreadTeam& team,
                          const HitBuffers<T>& out);

}  // namespace edgegrad
