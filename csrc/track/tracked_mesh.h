// Holds what of a tracked mesh does not depend on its pose: rays, edges with their faces, and points on its surface.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/parallel.h"
#include "rays/geometry.h"
#include "track/pose.h"
#include "track/settings.h"
#include "track/view.h"

namespace edgegrad {

// Holds points on the surface, with unit normals; and for points of a texture its colours at blurs of 1, 2, 4 ...
// texels, and how many texels there are to a world unit.
struct SurfacePoints {
    std::vector<Vec3> X, normal;
    std::vector<float> colors;  // (levels, N, 3) linear albedo
    std::vector<float> texels;  // (N,)
    std::vector<int32_t> rank;  // (N,) along a curve through space: rays to successive points are coherent
    int levels = 0;

    void find_ranks();
    int size() const { return int(X.size()); }
};

// Holds an edge with one or two faces. A face lies on the side `side` of the edge from a to b where it has the
// orientation 1 in the image; face[1] is -1 at a border.
struct TrackedEdge {
    int32_t a, b;
    int32_t face[2];
    int8_t side[2];
};

class TrackedMesh {
   public:
    // Takes vertices (V, 3) relative to the object's centre, world units. The arrays are copied.
    TrackedMesh(const int32_t* faces, int64_t n_faces, const double* verts, int64_t n_verts, const Spacing& spacing,
                SurfacePoints textured, SurfacePoints surface, ThreadTeam& team);

    // Writes 1 or -1 for each face: its orientation in the image of the camera, as Camera::facing() has it, 0 for
    // degenerate ones.
    void find_orientations(const TrackCamera& camera, const RigidPose& pose, int8_t* out) const;

    const RayCaster& caster() const { return geometry_->caster(); }
    Vec3 vertex(int32_t v) const {
        return {verts_[3 * int64_t(v)], verts_[3 * int64_t(v) + 1], verts_[3 * int64_t(v) + 2]};
    }
    std::span<const TrackedEdge> edges() const { return edges_; }
    // Returns the edges whose two faces meet at more than 30 degrees, which a picture may show within the outline.
    std::span<const int32_t> sharp_edges() const { return sharp_edges_; }
    int64_t n_faces() const { return int64_t(offset_.size()); }
    double size() const { return size_; }  // length of the diagonal of its box, world units
    double radius() const { return radius_; }
    // The local histograms belong to these points, spread over the mesh.
    const std::vector<Vec3>& centres() const { return centres_; }

    const SurfacePoints textured, surface;

   private:
    void spread_centres();
    Vec3 normal(int64_t f) const { return {normal_[0][f], normal_[1][f], normal_[2][f]}; }

    std::vector<double> verts_;
    std::shared_ptr<const Geometry> geometry_;
    std::vector<double> normal_[3], offset_;  // of the planes: normal . X = offset
    std::vector<TrackedEdge> edges_;
    std::vector<int32_t> sharp_edges_;
    std::vector<Vec3> centres_;
    double size_, radius_;
};

}  // namespace edgegrad
