// Finds points on the occluding contour of a mesh at a pose: on edges whose faces lie on one side of them in the image,
// where the object ends or lies before itself. No views are computed beforehand. A fixed point of the mesh moves along
// the contour's normal as the contour does, to first order: the contour slides along itself only (Cipolla and Giblin,
// Visual Motion of Curves and Surfaces, 2000).
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "track/tracked_mesh.h"

namespace edgegrad {

// Holds an object that may cover others.
struct PosedMesh {
    const TrackedMesh* mesh;
    RigidPose pose;
};

// Tests what the objects cover, a batch of rays of the camera's frame at a time.
class Visibility {
   public:
    Visibility(const TrackCamera& camera, std::span<const PosedMesh> objects) : camera_(camera), objects_(objects) {}

    // Writes 1 for each of n rays (at most RayBatch::size) that hits the object before their end.
    void test(RayBatch& batch, int object, const Ray* rays, int n, uint8_t* hidden) const;
    // Adds those that hit another object.
    void test_others(RayBatch& batch, int object, const Ray* rays, int n, uint8_t* hidden) const;
    // Returns the ray from the viewer to a point q near an object, which it reaches at 1.
    Ray ray_to(Vec3 q) const;

    const TrackCamera& camera() const { return camera_; }
    std::span<const PosedMesh> objects() const { return objects_; }

   private:
    const TrackCamera& camera_;
    std::span<const PosedMesh> objects_;
};

// Holds a point of the contour: on the mesh, and in the image with the unit normal that points outwards.
struct ContourPoint {
    Vec3 X;
    Vec2 x, n;
    float inside, outside;  // px along the normal to where the object ends, and to where it begins again
};

class Contour {
   public:
    explicit Contour(const TrackedMesh& mesh);

    // Finds at most TrackSettings::lines visible points. `phase` in [0, 1) shifts them along the contour, and `reach`
    // px is how far lines look for the contour. `sharp`: also points on sharp edges.
    void find(const Visibility& visibility, int object, double phase, double reach, bool sharp = false);

    std::span<const ContourPoint> points() const { return points_; }
    // Returns visible points on sharp edges within the outline.
    std::span<const ContourPoint> sharp_points() const { return sharp_; }
    // Returns the share of the drawn candidates that lie in the image and that nothing covers, of those that are on the
    // outline.
    double visible_share() const { return visible_share_; }
    // This is the share of candidates on the outline, by which the next ones are as many as needed.
    double outline_share() const { return outline_share_; }
    void set_outline_share(double share) { outline_share_ = share; }

   private:
    void gather_edges(const TrackCamera& camera, const RigidPose& pose, bool sharp);
    void draw_candidates(const TrackCamera& camera, const RigidPose& pose, double phase, int count);
    void drop_hidden(const Visibility& visibility, int object);
    void keep_visible_sharp(const Visibility& visibility, int object);
    void find_crossings(double reach);

    struct EdgePiece {
        int32_t edge;
        double end;  // px along all pieces
    };

    const TrackedMesh& mesh_;
    std::vector<int8_t> orientation_;
    std::vector<EdgePiece> pieces_;
    std::vector<ContourPoint> candidates_, points_, sharp_;
    std::vector<int> order_;
    RayBatch batch_;
    double visible_share_ = 0, outline_share_ = 0.5, spacing_ = 0;
};

}  // namespace edgegrad
