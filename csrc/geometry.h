// What depends on faces and positions alone, kept between calls: the ray structure and the edges.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "raycast.h"
#include "topology.h"

namespace edgegrad {

// What acquire_geometry is to have ready besides the ray structure.
struct GeometryWanted {
    bool topology = false, parts = false;
};

// What it had to do.
struct GeometryWork {
    bool rays = false;   // built or updated the ray structure
    bool edges = false;  // found or welded the edges
};

class Geometry {
   public:
    Geometry(const int32_t* faces, int64_t n_faces, int64_t n_verts);

    const RayCaster& caster() const { return caster_; }

    // The edges at the current positions; made when first asked for. Not to be called by two threads at once for the
    // same geometry: acquire_geometry does it.
    const Topology& topology() const { return *topology_; }

    // The same holds for these.
    const Parts& parts() const { return *parts_; }

   private:
    friend std::shared_ptr<const Geometry> acquire_geometry(const int32_t*, int64_t, const double*, int64_t, double,
                                                            GeometryWanted, Team&, GeometryWork&);

    std::vector<int32_t> faces_;
    std::vector<double> verts_;
    RayCaster caster_;
    std::unique_ptr<Topology> topology_;
    std::unique_ptr<Parts> parts_;
    double spacing_ = 0;   // of the numbers in which the user gave the positions: decides what is welded
    bool welded_ = false;  // at the current positions
};

// The geometry of these faces at these positions, with what is wanted. One that is still in memory is used
// again: as it is when the positions are the same, updated when they moved and nobody else uses it. What is compared is
// the content of the arrays, so tensors may be copied, changed in place or freed without harm.
std::shared_ptr<const Geometry> acquire_geometry(const int32_t* faces, int64_t n_faces, const double* verts,
                                                 int64_t n_verts, double spacing, GeometryWanted wanted, Team& team,
                                                 GeometryWork& work);

// Forgets all kept geometry that is not in use.
void clear_geometry();

// To be called around fork(), so that the child can render. Only the thread that forks lives on there. Before, wait
// until no thread changes kept geometry or builds a ray structure, since the child would find their locks taken.
void before_fork();
void after_fork(bool child);  // in the parent and in the child

}  // namespace edgegrad
