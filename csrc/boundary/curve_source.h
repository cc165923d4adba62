// What the estimator (primary_curves.cpp) knows of a curve along which the image jumps.
//
// A sample is a point of a curve. Its ray, from the camera to that point, ignores the faces that meet in the curve;
// what it finds hides the point, or lies behind it. A source of curves says where the point is and which faces the ray
// ignores, then which surfaces the two sides show, and at last, given their radiance, adds the adjoint of the motion.
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

// A point of a face, or, with face −1, of the background.
struct SurfacePoint {
    int64_t face = -1;
    Barycentrics b;
    double depth = std::numeric_limits<double>::infinity();
};

// Faces that meet in a curve, and how exactly the input says where it lies: the largest coordinate of its ends in the
// world, and the relative spacing of such numbers.
struct CurveFaces {
    std::span<const int32_t> faces;
    double coordinate = 0, spacing = 0;

    // Of a curve on one face, which is kept where `face` lies.
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
    Vec2 u, n;              // the place in the undistorted image, and its normalised coordinates
    Vec2 sight;             // the normalised coordinates at which the camera's ray asks what hides the point
    Vec2 x;                 // the pixel position
    double area_scale = 1;  // how much larger an area is there than in the undistorted image
    Vec3 point;             // camera coordinates
    double weight = 0;      // inverse of the density of samples along the curve's fraction s
    SurfacePoint behind = {};

    // What the ray does not see; ascends if it is more than 16. `gathered` keeps them where they are not listed
    // elsewhere.
    std::span<const int32_t> ignored;
    std::vector<int32_t> gathered;
    std::vector<int32_t> transparent;  // before it, through which it is seen
};

// The surfaces of which a sample needs the radiance: minus, plus, and at most one more.
struct SampleSurfaces {
    static constexpr int most = 3;
    SurfacePoint at[most];
    int count = 2;
};

// What a sample's weight times the jump of the radiance, L₋ − L₊, is for what the curve moves with; and, of another
// curve that lies on it, for what that one moves with (coincidence.h). Or the velocities δx ∧ τ of both.
struct CurveJumps {
    double first = 0, second = 0;
};

// What a accumulation asks of a curve on which a sample lies, at the pixel position `sample.x`. `jumps` takes one
// number, linear in the radiance, of each of the surfaces. `add_motion` takes the jumps of the loss; `velocities` is
// what it is the adjoint of, in one direction, and `normal` that of places x in the image. `finish` adds what was
// summed for the latest curve.
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

// `place` sets where the fraction s of a curve lies, of a sample that has its x, n and weight; false if no ray is
// needed to know that nothing shows there. `faces_of` serves the test whether what the ray meets hides the point.
// `cast` tells that no sample waits any more.
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
