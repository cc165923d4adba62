// Compares points of the surface with a depth image. About a point q with the normal N, the surface lies in a plane, so
// that the ray o + z d of a pixel meets it at z = N . (q - o) / N . d, and dz = N . dq / N . d. A measurement is that
// of the surface, with the normal density of its difference and the sensor's deviation, or else anything within the
// object's size, as in fit_pose.
#pragma once

#include <vector>

#include "track/contour.h"
#include "track/normal_equations.h"

namespace edgegrad {

// Views depths (H, W) along the camera's axis, world units; NaN, infinite or at most 0 where there is none.
struct DepthView {
    const float* z;
    int width, height;
};

class DepthTerm {
   public:
    explicit DepthTerm(const TrackedMesh& mesh);

    void choose_visible(const Visibility& visibility, int object);
    void add(const DepthView& depth, const TrackCamera& camera, const PosedMesh& object, NormalEquations& to);

    // Returns the share of measurements that are of the surface.
    double explained() const { return explained_; }

   private:
    struct Row {
        double J[6], residual;
    };
    const SurfacePoints& points_;
    std::vector<int32_t> chosen_;
    std::vector<Row> rows_;
    std::vector<double> sizes_;
    RayBatch batch_;
    double explained_ = 0;
};

}  // namespace edgegrad
