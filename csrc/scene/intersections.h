// Where faces pass through each other, of all meshes and of each with itself.
#pragma once

#include <cstdint>

#include "core/array.h"
#include "core/parallel.h"
#include "scene/face_tree.h"
#include "scene/scene.h"
#include "scene/topology.h"

namespace edgegrad {

struct Intersection {
    int32_t face[2];  // ascending
    // Where the surface passes through a face exactly along an edge: face[beside] ends there, and `next` goes on on the
    // other side. Moved one way, the one passes through, moved the other way, the other; so each counts half.
    int32_t next = -1;
    int32_t beside = 0;
    // The share of the gradient that goes to these two: copies of faces in the same place have the same segment.
    double weight = 1;
    Vec3 a, b;  // the ends of the segment that both share, in the world
};

class Intersections {
   public:
    // Of these faces (F, 3) at these positions (V, 3), with the edges there. `order` is kept from time to time.
    Intersections(const int32_t* faces, int64_t n_faces, const double* verts, const Spacing& spacing,
                  const Topology& topology, FaceOrder& order, Team& team);

    // By ascending faces.
    const Array<Intersection>& all() const { return all_; }

    // For how many each of them stands: more than 1 where there would be too many, and some are drawn.
    double each_stands_for() const { return stands_for_; }

    // Of so many that are found among so many faces, before and after they are sorted, and what they are sorted by.
    // Lists double as they grow.
    static int64_t bytes(int64_t found, int64_t faces) {
        return found * int64_t(3 * sizeof(Intersection) + sizeof(uint64_t)) + faces * int64_t(sizeof(uint32_t));
    }

   private:
    Array<Intersection> all_{0};
    double stands_for_ = 1;
};

}  // namespace edgegrad
