// Follows objects from frame to frame. Lines across the contour, points of the texture and depth give a pose's
// log-likelihood; a constant velocity predicts it, with a variance that the film teaches. Their curvatures add up,
//
//     H = sum J^T J / var,   d = H^-1 g,   covariance = inflation H^-1.
//
// A rigid pose moves the camera into the mesh's frame, so that a ray structure is built once. A frame allocates
// nothing, and an object takes one thread, so that results have the same bits at any number of threads.
#pragma once

#include <memory>
#include <vector>

#include "core/parallel.h"
#include "track/depth.h"
#include "track/lines.h"
#include "track/texture.h"

namespace edgegrad {

// Says what an update found of one object.
struct TrackedObject {
    RigidPose pose;
    double covariance[36];     // of the step (w, t)
    double edges = 0;          // share of the lines that show an edge close to the contour
    double gain = 0;           // mean of how much likelier an edge is than none on a line, nats
    double visible = 0;        // share of the outline that is in the image, and that nothing covers
    double residual = 0;       // root mean square of the lines' residuals, in their standard deviations
    double texture = 0;        // share of the texture's points that are explained; 0 without any
    double texture_noise = 0;  // their deviation, linear radiance
    double depth = 0;          // share of depths that are the surface's
    double pixels = 0;         // px across the object
    double surprise = 0;       // length of the step from the prediction, in the prediction's standard deviations
    int lines = 0;
};

// Says how long the parts of an update took, seconds.
struct TrackTimes {
    double read = 0, contour = 0, lines = 0, texture = 0, depth = 0, solve = 0, learn = 0;
};

class Tracker {
   public:
    explicit Tracker(const Camera& camera) : camera_(camera) {}
    Tracker(const Tracker&) = delete;

    // Adds an object at its first pose. Others may cover it.
    void add(std::unique_ptr<TrackedMesh> mesh, const RigidPose& pose);
    int size() const { return int(objects_.size()); }
    const TrackCamera& camera() const { return camera_; }
    const TrackedMesh& mesh(int object) const { return *objects_[object]->mesh; }

    // Follows all objects to the next frame; `depth` may be null.
    void update(const FrameView& frame, const DepthView* depth, ThreadTeam& team);
    const TrackedObject& found(int object) const { return objects_[object]->found; }
    const TrackTimes& times(int object) const { return objects_[object]->times; }

    // Moves an object to where it was found again, at rest.
    void place(int object, const RigidPose& pose);
    // Returns whether an outline of the object is in view at its present pose.
    bool is_in_view(int object);

    // These are all numbers that the next update depends on.
    static constexpr int numbers = 9 + 3 + 6 + 3 + 27 + 2 + SideModels::count + 1;
    void save(int object, double* out) const;
    void load(int object, const double* in);
    std::span<float> colors(int object) { return objects_[object]->histograms.state(); }
    void load_colors(int object, const float* in);

   private:
    struct Object {
        explicit Object(std::unique_ptr<TrackedMesh> mesh_, const TrackCamera& camera);

        std::unique_ptr<TrackedMesh> mesh;
        RigidPose pose;
        double velocity[6] = {};  // step of a frame: rotation vector, and shift in sizes
        double deviation;         // of each entry of a step from the predicted pose
        int frames = 0;           // updates in all, and since the object was placed
        int since = 0;
        Frame frame;
        Contour contour;
        ColorHistograms histograms;
        LineTerm lines;
        std::vector<ContourPoint> good;  // whose lines show an edge
        TextureTerm texture;
        DepthTerm depth;
        std::vector<PosedMesh> posed;  // all objects as this one takes them to be
        TrackedObject found;
        TrackTimes times;
    };
    void follow(int index, const FrameView& frame, const DepthView* depth);
    void descend(int index, const RigidPose& predicted, const DepthView* depth);
    void learn(Object& object, double rate, bool all);
    void move(Object& object, const RigidPose& before, double square);
    void require_pixels(Object& object, int index, double reach);
    double pixels_across(const Object& object, const RigidPose& pose) const;
    RigidPose predicted(const Object& object) const;

    TrackCamera camera_;
    std::vector<std::unique_ptr<Object>> objects_;
};

}  // namespace edgegrad
