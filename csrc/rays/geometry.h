// What depends on faces and positions alone, kept between calls: the ray structure, the edges, and where
// faces pass through each other.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "rays/raycast.h"
#include "scene/intersections.h"
#include "scene/topology.h"

namespace edgegrad {

// What acquire_geometry is to have ready besides the ray structure.
struct GeometryWanted {
    bool topology = false, parts = false, intersections = false;
};

// What it had to do.
struct GeometryWork {
    bool rays = false;           // built or updated the ray structure
    bool edges = false;          // found or welded the edges
    bool intersections = false;  // found where faces pass through each other
};

class Geometry {
   public:
    Geometry(const int32_t* faces, int64_t n_faces, int64_t n_verts);

    const RayCaster& caster() const { return caster_; }

    // These are there if acquire_geometry was asked for them; edges and intersections are those at the current
    // positions.
    const Topology& topology() const { return *topology_; }
    const Parts& parts() const { return *parts_; }
    const Intersections& intersections() const { return *intersections_; }

   private:
    friend class KeptGeometry;

    std::vector<int32_t> faces_;
    std::vector<double> verts_;
    RayCaster caster_;
    std::unique_ptr<Topology> topology_;
    std::unique_ptr<Parts> parts_;
    std::unique_ptr<Intersections> intersections_;  // null: not found yet at the current positions
    FaceOrder order_;                               // that they were found in
    Spacing spacing_;                               // decides what is welded
    bool welded_ = false;                           // at the current positions
};

// The geometry of these faces at these positions, with what is wanted. One that is still in memory is used
// again: as it is when the positions are the same, updated when they moved and nobody else uses it. What is compared is
// the content of the arrays, so tensors may be copied, changed in place or freed without harm. What can take long is
// done without a lock: a signal handler may render, or wait for a thread that does. So two threads that ask for the
// same new geometry at once both make it, and one is kept. Throws Interrupted where the call is to stop.
std::shared_ptr<const Geometry> acquire_geometry(const int32_t* faces, int64_t n_faces, const double* verts,
                                                 int64_t n_verts, const Spacing& spacing, GeometryWanted wanted,
                                                 ThreadTeam& team, GeometryWork& work);

// Forgets all kept geometry that is not in use.
void clear_geometry();

// To be called around fork(), so that the child can render. Only the thread that forks lives on there. Before, wait
// until no thread changes kept geometry or builds a ray structure, since the child would find their locks taken.
void before_fork();
void after_fork();  // in the parent and in the child

}  // namespace edgegrad
