// Compares points of the texture with the frame. The albedo T of a point is known, at several blurs; the light is not:
//
//     I(x) = T L(n) + noise,
//
// with L nine spherical harmonics a channel of the normal (Ramamoorthi and Hanrahan, SIGGRAPH 2001), linear and so
// projected out of each step (variable projection). The noise is normal, with a deviation from the median of residuals,
// and Tukey's weights leave out what the model does not explain: highlights, shadows' borders, and what covers the
// object.
#pragma once

#include <cstdint>
#include <vector>

#include "track/contour.h"
#include "track/frame.h"
#include "track/normal_equations.h"

namespace edgegrad {

// Writes nine harmonics of a unit normal, each of about the same size.
void harmonics(Vec3 n, float out[9]);

class TextureTerm {
   public:
    explicit TextureTerm(const TrackedMesh& mesh);

    // Holds what is learnt of the light.
    struct Light {
        double harmonics[3][9] = {};
        double deviation = 0.1;  // linear radiance
        bool known = false;
    };

    bool exists() const { return points_.size() > 0; }
    // Chooses points that the camera sees at a pose.
    void choose_visible(const Visibility& visibility, int object);
    // Adds the term at a pose, on a level of the frame's pyramid, and updates the light.
    void add(const Frame& frame, int level, const TrackCamera& camera, const PosedMesh& object, NormalEquations& to);

    const std::vector<int32_t>& chosen() const { return chosen_; }
    Light light;
    // Returns the share of the chosen points that the model explains.
    double explained() const { return explained_; }
    // Returns the share of points that nothing else covers, of those that look at the camera.
    double visible_share() const { return visible_share_; }

   private:
    static constexpr int light_rows = 9, width = 16;  // a row: 9 of light, 6 of the step, 1 of the frame
    void read_points(const Frame& frame, int level, const TrackCamera& camera, const PosedMesh& object);
    void weigh();
    bool sum_channel(int channel, double (&M)[width][width]) const;

    const SurfacePoints& points_;
    std::vector<int32_t> chosen_;
    std::vector<float> row_;                // (chosen, 3, width)
    std::vector<float> weight_, residual_;  // (chosen,), and absolute residuals in no order
    std::vector<uint8_t> usable_;
    RayBatch batch_;
    double explained_ = 0, visible_share_ = 0;
};

// Chooses visible points of a surface, at most `most`, in their order; returns the share of tested points that are
// visible.
double choose_visible_points(const SurfacePoints& points, const Visibility& visibility, int object, RayBatch& batch,
                             std::vector<int32_t>& chosen);

}  // namespace edgegrad
