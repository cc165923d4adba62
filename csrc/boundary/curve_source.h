// This file declares the interface of curve sources for the boundary estimators. A curve is where the image jumps.
//
// A sample is a point of a curve. Its primary ray ignores the faces that meet in the curve; what the ray hits occludes
// the point, or lies behind it. A curve source first gives the point and the ignored faces, then the surfaces on both
// sides. Given their radiance, it adds the adjoint of the motion.
#pragma once

#include <algorithm>
#include <cmath>
#include <concepts>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "accumulate/scatter.h"
#include "accumulate/tangent.h"
#include "camera/face_map.h"

namespace edgegrad {

// A SurfacePoint is a point of a face, or, with face −1, of the background.
struct SurfacePoint {
    int64_t face = -1;
    Barycentrics b;
    double depth = std::numeric_limits<double>::infinity();
};

// CurveFaces holds the faces that meet in a curve, and the precision of its position. These are the largest world
// coordinate of its ends, and the relative spacing of such numbers.
struct CurveFaces {
    std::span<const int32_t> faces;
    double coordinate = 0, spacing = 0;

    // Returns the CurveFaces of a curve on one face. It refers to `face`, which must outlive it.
    template <class T>
    static CurveFaces on(const SceneView<T>& scene, const int32_t& face) {
        const int32_t* vertex = scene.faces + 3 * int64_t(face);
        CurveFaces out{{&face, 1}, 0, scene.spacing->of(vertex[0])};
        for (int i = 0; i < 3; ++i)
            for (int axis = 0; axis < 3; ++axis)
                out.coordinate =
                    std::max(out.coordinate, std::fabs(double(scene.verts[3 * int64_t(vertex[i]) + axis])));
        return out;
    }
};

struct CurveSample {
    Vec2 u, n;              // position in the undistorted image, and its normalised coordinates
    Vec2 sight;             // normalised coordinates of the ray that finds occluders
    Vec2 x;                 // pixel position
    double area_scale = 1;  // area scale from the undistorted image to the pixels
    Vec3 point;             // camera coordinates
    double weight = 0;      // reciprocal density of samples along the curve's fraction s
    SurfacePoint behind = {};

    // The ray ignores these faces; more than 16 must ascend. `gathered` stores them where no other list does.
    std::span<const int32_t> ignored;
    std::vector<int32_t> gathered;
    std::vector<int32_t> transparent;  // transparent faces before the point, through which it is seen
};

// SampleSurfaces holds the surfaces of which a sample needs the radiance: minus, plus, and at most one more.
struct SampleSurfaces {
    static constexpr int most = 3;
    SurfacePoint at[most];
    int count = 2;
};

// CurveJumps holds a sample's weight times the jump of the radiance, L₋ − L₊, for the curve's own motion. `second` is
// that of another curve that coincides with it (coincidence.h). It also holds the velocities δx ∧ τ of both.
struct CurveJumps {
    double first = 0, second = 0;
};

// MovingCurve is what an accumulation requires of a curve with a sample at the pixel position `sample.x`. `jumps` takes
// one number per surface, linear in the radiance. `add_motion` takes the jumps of the loss. It is the adjoint of
// `velocities`, which takes one direction. `normal` is the derivative of that velocity by the image position x.
// `finish` adds the sums of the latest curve.
template <class S>
concept MovingCurve = requires(S& source, const S& known, typename S::Sample& sample, const double* radiance,
                               CurveJumps jumps, const Direction& direction, LocalGradients& grad) {
    { sample.x } -> std::same_as<Vec2&>;
    { source.surfaces(sample) } -> std::same_as<SampleSurfaces>;
    { known.jumps(sample, radiance) } -> std::same_as<CurveJumps>;
    { known.velocities(sample, direction) } -> std::same_as<CurveJumps>;
    { known.normal(sample) } -> std::same_as<Vec2>;
    source.add_motion(sample, jumps, grad);
    source.finish(grad);
};

// CurveSource adds what tracing requires. `place` sets the fraction s of a curve, for a sample with its x, n and
// weight. It returns false if nothing shows there even without a ray. `faces_of` serves the occlusion test. `cast`
// announces that no sample is pending any more.
template <class S>
concept CurveSource =
    MovingCurve<S> && std::derived_from<typename S::Sample, CurveSample> &&
    requires(S& source, const S& known, typename S::Sample& sample, const typename S::Curve& curve, double s) {
        { known.position(curve, s) } -> std::same_as<Vec2>;
        { source.place(curve, s, sample) } -> std::same_as<bool>;
        { known.faces_of(sample) } -> std::same_as<const CurveFaces&>;
        source.cast();
    };

}  // namespace edgegrad
