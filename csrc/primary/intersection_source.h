// This file holds the curve source of lines along which faces intersect.
//
// For two planes A and B, let F be the difference of a quantity that is affine in the image: 1/z in perspective, −z in
// an orthographic view.
//
//     F(x) = 1/z_A − 1/z_B   or   z_B − z_A,     A is in front where F > 0.
//
// The curve F = 0 is straight, and contributes ∫ Ã · [L_A − L_B] δF / |∇F| dℓ to ∂loss/∂Φ. δF is taken at fixed x, on
// the plane with the normal N through q_i, along the ray q(z) at x:
//
//     (N · dq/dz) δz = N · (Σ b_i δq_i − δq(z)).
//
// Where a lens distorts the image, dℓ / |∇F| is that of the undistorted image times the area scale.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "boundary/curve_source.h"
#include "estimator/view.h"
#include "rays/alpha_mask.h"
#include "scene/intersections.h"

namespace edgegrad {

// An IntersectionCurve is an intersection line in the image.
struct IntersectionCurve {
    const Intersection* faces = nullptr;
    Vec3 a, b;              // ends within the view, camera coordinates
    double w0 = 1, w1 = 1;  // depth weights of the ends
    Vec2 x0, x1;            // pixel positions of the ends
    double length = 0;      // px

    // low() and high() return corners of its box.
    Vec2 low() const { return {std::min(x0.x, x1.x), std::min(x0.y, x1.y)}; }
    Vec2 high() const { return {std::max(x0.x, x1.x), std::max(x0.y, x1.y)}; }
    double nearest_depth() const { return std::min(a.z, b.z); }
};

// Sets the curve. Returns false if it is out of view or a face is seen edge-on. Returns false, too, for an edge that is
// a silhouette, which is a curve by itself. For `facing` (F,) see facing_of_faces.
template <class T>
bool find_intersection(const BackwardView<T>& view, const Array<int8_t>& facing, const Intersection& i,
                       IntersectionCurve& c) {
    if (facing[i.face[0]] == 0 || facing[i.face[1]] == 0) return false;
    if (i.next >= 0 && facing[i.next] * facing[i.face[i.ending]] <= 0) return false;
    const Camera& camera = view.camera;
    const Vec3 a = camera.to_camera(i.a), b = camera.to_camera(i.b);
    double t0, t1;
    if (!view.volume.clip_segment(a, b, t0, t1)) return false;
    c.faces = &i;
    c.a = (1 - t0) * a + t0 * b, c.b = (1 - t1) * a + t1 * b;
    c.w0 = camera.depth_weight(c.a), c.w1 = camera.depth_weight(c.b);
    if (!(c.w0 > 0 && c.w1 > 0)) return false;  // The line ends in the eye itself.
    c.x0 = view.volume.inside(project(camera, c.a)), c.x1 = view.volume.inside(project(camera, c.b));
    c.length = length(c.x1 - c.x0);
    return c.length > 0 && std::isfinite(c.length);
}

// IntersectionPlanes holds what the points of a curve share of the planes of both faces.
struct IntersectionPlanes {
    FaceMap map[2];
    Vec3 normal[2];
    Vec2 slope;        // ∂F/∂n
    double scale = 0;  // length / |∇F| in the undistorted image, times the weight of the intersection

    template <class T>
    IntersectionPlanes& set(const BackwardView<T>& view, const IntersectionCurve& curve) {
        const Camera& camera = view.camera;
        slope = {};
        for (int k = 0; k < 2; ++k) {
            const auto q = corners_of(view, curve.faces->face[k]);
            map[k] = face_map(camera, q.data());
            normal[k] = cross(q[1] - q[0], q[2] - q[0]);
            slope += (k ? -1.0 : 1.0) * camera.affine_depth_gradient(normal[k], q[0]);
        }
        scale = curve.faces->weight * curve.length / length(place_vjp(camera, slope));
        return *this;
    }

    // Returns the length, px, of a silhouette whose motion would change the image as much, at a point of the curve.
    double as_silhouette(const Camera& camera, double z, Vec2 n) const {
        double squares = 0;
        for (const Vec3 N : normal) squares += dot(N, N) / std::pow(camera.along_ray(N, n), 2);
        return scale * std::fabs(camera.affine_depth_slope(z)) * camera.pixel_at_depth(z) * std::sqrt(squares / 2);
    }
};

template <class T>
class IntersectionSource {
   public:
    using Curve = IntersectionCurve;

    struct Sample : CurveSample {
        int pending_curve = 0;
        SurfacePoint side[2];
    };

    explicit IntersectionSource(const BackwardView<T>& view) : view_(view) {}

    Vec2 position(const Curve& curve, double s) const { return curve.x0 + s * (curve.x1 - curve.x0); }

    bool place(const Curve& curve, double s, Sample& sample) {
        const bool another = n_pending_ == 0 || pending_[n_pending_ - 1].curve.faces != curve.faces;
        if (another) start(pending_[n_pending_++], curve);
        PendingCurve& pending = pending_[n_pending_ - 1];
        const double t = s * curve.w0 / ((1 - s) * curve.w1 + s * curve.w0);
        sample.pending_curve = n_pending_ - 1;
        sample.point = (1 - t) * curve.a + t * curve.b;
        sample.behind = {};
        sample.ignored = pending.faces.faces;
        for (int k = 0; k < 2; ++k) {
            sample.side[k] = {curve.faces->face[k], barycentrics_of_hit(pending.planes.map[k], sample.n),
                              sample.point.z};
        }
        // A face seen edge-on has no image.
        bool visible = std::isfinite(pending.planes.scale);
        for (const Vec3 N : pending.planes.normal) visible &= view_.camera.along_ray(N, sample.n) != 0;
        for (const SurfacePoint& p : sample.side) visible &= shows(view_.scene, p.face, p.b);
        if (!visible) n_pending_ -= another;
        return visible;
    }

    const CurveFaces& faces_of(const Sample& sample) const { return pending_[sample.pending_curve].faces; }

    SampleSurfaces surfaces(const Sample& sample) const { return {{sample.side[0], sample.side[1]}}; }

    CurveJumps jumps(const Sample& sample, const double* radiance) const {
        return {sample.weight * (radiance[0] - radiance[1]), 0};
    }

    // The curve moves with δx as F does with −δx.
    Vec2 normal(const Sample& sample) const {
        const PendingCurve& pending = pending_[sample.pending_curve];
        return (-pending.planes.scale * sample.area_scale) * pixel_vjp(view_.camera, sample.n, pending.planes.slope);
    }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const PendingCurve& pending = pending_[sample.pending_curve];
        const double z = sample.point.z;
        const Vec2 n_dot = normalised_jvp(view_.camera, sample.n, direction.intrinsics);
        double F_dot = 0;
        for (int k = 0; k < 2; ++k) {
            const Vec3 N = pending.planes.normal[k];
            double moved = -view_.camera.unit_at_depth(z) * (N.x * n_dot.x + N.y * n_dot.y);
            for (int i = 0; i < 3; ++i)
                moved += sample.side[k].b[i] *
                         dot(N, direction.q[view_.scene.faces[3 * int64_t(pending.curve.faces->face[k]) + i]]);
            F_dot += (k ? -1 : 1) * view_.camera.affine_depth_slope(z) * moved / view_.camera.along_ray(N, sample.n);
        }
        return {pending.planes.scale * sample.area_scale * F_dot, 0};
    }

    void add_motion(const Sample& sample, CurveJumps jumps, LocalGradients& grad) {
        const PendingCurve& pending = pending_[sample.pending_curve];
        if (current_ != pending.curve.faces) finish(grad), current_ = pending.curve.faces;
        const double z = sample.point.z, F_bar = pending.planes.scale * sample.area_scale * jumps.first;
        Vec2 n_bar;
        for (int k = 0; k < 2; ++k) {
            const Vec3 N = pending.planes.normal[k];
            const double z_bar =
                (k ? -F_bar : F_bar) * view_.camera.affine_depth_slope(z) / view_.camera.along_ray(N, sample.n);
            for (int i = 0; i < 3; ++i) q_bar_[k][i] += z_bar * sample.side[k].b[i] * N;
            n_bar += (-z_bar * view_.camera.unit_at_depth(z)) * Vec2{N.x, N.y};
        }
        normalised_vjp(view_.camera, sample.n, n_bar, grad.k);
    }

    void cast() { n_pending_ = 0; }

    // Adds the sums of the latest curve.
    void finish(LocalGradients& grad) {
        if (!current_) return;
        for (int k = 0; k < 2; ++k)
            for (int i = 0; i < 3; ++i) {
                grad.q.add<3>(view_.scene.faces[3 * int64_t(current_->face[k]) + i], &q_bar_[k][i].x);
                q_bar_[k][i] = {};
            }
        current_ = nullptr;
    }

   private:
    // A PendingCurve is a curve with pending samples.
    struct PendingCurve {
        Curve curve;
        IntersectionPlanes planes;
        CurveFaces faces;
    };

    void start(PendingCurve& pending, const Curve& curve) {
        pending.curve = curve;
        pending.planes.set(view_, curve);
        const int32_t (&face)[2] = curve.faces->face;
        pending.faces = {face, 0, 0};
        for (const int32_t f : face)
            for (int i = 0; i < 3; ++i) {
                const int32_t v = view_.scene.faces[3 * int64_t(f) + i];
                pending.faces.spacing = std::max(pending.faces.spacing, view_.scene.spacing->of(v));
                for (int axis = 0; axis < 3; ++axis)
                    pending.faces.coordinate =
                        std::max(pending.faces.coordinate, std::fabs(view_.scene.verts[3 * int64_t(v) + axis]));
            }
    }

    const BackwardView<T>& view_;
    PendingCurve pending_[RayBatch::size];  // curves of the pending samples
    int n_pending_ = 0;

    // The members below sum over the latest curve, by the corners of both faces.
    const Intersection* current_ = nullptr;
    Vec3 q_bar_[2][3];
};

}  // namespace edgegrad
