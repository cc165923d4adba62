// Where in an image rays may hit something.
#pragma once

#include <algorithm>
#include <limits>
#include <numeric>
#include <vector>

#include "camera/camera.h"
#include "core/array.h"
#include "core/parallel.h"
#include "rays/raycast.h"

namespace edgegrad {

// So many pixels fill batches of rays. Only whole batches are left out: which rays lie in a packet decides which of two
// faces at one depth wins.
inline int pixels_of_batches(int spp) { return RayBatch::size / std::gcd(RayBatch::size, spp); }

// The pixels whose samples may hit something: those in an octagon around the images of all vertices of faces, if these
// lie before the eye. With a pixel more on each side, for Embree sees positions rounded to floats. Through a lens the
// octagon of the undistorted image is bent, and each row reaches from its first place there to its last.
class ReachablePixels {
   public:
    // `q` are the vertices in the camera's frame.
    ReachablePixels(const Camera& camera, const RayCaster& caster, const Array<Vec3>& q, double radius,
                    ThreadTeam& team);

    // In row y, half open.
    struct Range {
        int first, end;
    };
    Range row(int y) const;

   private:
    static constexpr double infinite = std::numeric_limits<double>::infinity();
    // Of x, y, x + y and x − y, px.
    struct Bounds {
        double low[4], high[4];

        Bounds() { std::fill(low, low + 4, infinite), std::fill(high, high + 4, -infinite); }
        static Bounds everything() {
            Bounds b;
            std::fill(b.low, b.low + 4, -infinite), std::fill(b.high, b.high + 4, infinite);
            return b;
        }
        void add(int k, double x) { low[k] = std::min(low[k], x), high[k] = std::max(high[k], x); }
    };
    // The part of the octagon in a box.
    static std::vector<Vec2> polygon(const Bounds& bounds, Vec2 low, Vec2 high);
    void distort_bounds(const Camera& camera);

    int width_;
    double margin_;
    Bounds bounds_;
    // Behind a lens, each row has the span of the octagon's image, px. A pinhole has no spans.
    struct Span {
        double from = infinite, to = -infinite;
    };
    std::vector<Span> spans_;
};

}  // namespace edgegrad
