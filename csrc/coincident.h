// Curves that lie on one another in the image: the front and the back edge of a box that is seen straight on, meshes
// in the same place, a long edge against two short ones.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "math.h"
#include "parallel.h"

namespace edgegrad {

// A curve in the image, and how far, in pixels, the rays of Embree may miss it: its floats are no finer.
struct ImageSegment {
    int64_t edge;
    Vec2 a, b;
    double reach;
};

class CoincidentCurves {
   public:
    CoincidentCurves(const std::vector<ImageSegment>& segments, Team& team);

    bool empty() const { return edge_.empty(); }

    // The edges whose curves lie within reach of the curve of this one, wherever the two run side by side.
    std::span<const int64_t> of(int64_t edge) const;

   private:
    std::vector<int64_t> edge_, offset_, other_;  // ascending edges; the others of edge_[i] begin at offset_[i]
};

}  // namespace edgegrad
