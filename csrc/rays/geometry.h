// Keeps what depends on faces and positions alone between calls: ray structure, edges, and intersections of faces.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "rays/raycast.h"
#include "scene/intersections.h"
#include "scene/topology.h"

namespace edgegrad {

// Says what acquire_geometry must provide besides the ray structure.
struct GeometryWanted {
    bool topology = false, parts = false, intersections = false;
};

// Says what it had to do.
struct GeometryWork {
    bool rays = false;           // whether it built or updated the ray structure
    bool edges = false;          // whether it found or welded the edges
    bool intersections = false;  // whether it found the intersections of faces
};

class Geometry {
   public:
    Geometry(const int32_t* faces, int64_t n_faces, int64_t n_verts);

    const RayCaster& caster() const { return caster_; }

    // These exist if acquire_geometry was asked for them; edges and intersections are those at the current positions.
    const Topology& topology() const { return *topology_; }
    const ConnectedParts& parts() const { return *parts_; }
    const Intersections& intersections() const { return *intersections_; }

   private:
    friend class KeptGeometry;

    std::vector<int32_t> faces_;
    std::vector<double> verts_;
    RayCaster caster_;
    std::unique_ptr<Topology> topology_;
    std::unique_ptr<ConnectedParts> parts_;
    std::unique_ptr<Intersections> intersections_;  // Null means not found yet at the current positions.
    FaceOrder order_;                               // The intersections were found in this order.
    Spacing spacing_;                               // decides which vertices are welded
    bool welded_ = false;                           // whether it refers to the current positions
};

// Returns the geometry of these faces at these positions, with what is wanted. It reuses geometry in memory: unchanged
// at the same positions, or updated if nobody else uses it. Comparing the contents of arrays lets tensors be copied,
// changed in place or freed. Slow work needs no lock, because a signal handler may render, or wait for a thread that
// does. Two threads that request the same new geometry at once therefore both make it, and one is kept. Throws
// Interrupted where the call is to stop.
std::shared_ptr<const Geometry> acquire_geometry(const int32_t* faces, int64_t n_faces, const double* verts,
                                                 int64_t n_verts, const Spacing& spacing, GeometryWanted wanted,
                                                 ThreadTeam& team, GeometryWork& work);

// Releases all kept geometry that is not in use.
void clear_geometry();

// These surround fork(), so that the child can render. Only the forking thread survives there. before_fork() waits
// until no thread changes kept geometry or builds a ray structure, because the child would find their locks taken.
void before_fork();
void after_fork();  // The parent and the child both call it.

}  // namespace edgegrad
