// This file holds the curve source of secondary edges: edges (a, b) and alpha edges seen from a shading point. Each
// lies on the line between two points of a light path. y₁ is the shading point, which the image shows. y₂ is the
// reflector, which sends light to y₁.
//
// A surface takes the place of a light here, so one edge has no single image: each point of it and each line past it
// gives another. Lines are drawn by the point p = (1 − t) a + t b and the unit direction w. w lies in the wedge in
// which the faces of the edge have N · (y − p) < 0, with N = (b − a) × w. A line that moves by h along N / |N| passes
// the faces if h > 0. The measure of lines is |N| dh dt dω; at its ends it is cos θ₁ cos θ₂ / r² dA₁ dA₂. The edge
// therefore contributes to ∂loss/∂Φ
//
//     ∫∫ Ã |dx/dA₁| V f₁ L₂ δF dt dω,    F = N · (λ y₁ + (1 − λ) y₂ − p),    λ = |y₂ − p| / (|y₁ − p| + |y₂ − p|)
//
// Here f₁ L₂ is what y₁ scatters to the viewer of the light from y₂, and V tells whether the viewer sees y₁. The
// position of y₁ in the image is fixed; y₂ and p stay at their barycentrics on face and edge. The camera's ray is
// r = dq/dz, m is the normal of the face of y₁, c = N·r / m·r, and β and γ are the barycentrics of y₁ and y₂. Then
//
//     δF = λ c m · Σ β_i δv_i + (1 − λ) N · Σ γ_i δv_i − N · ((1 − t) δa + t δb) + λ (N − c m) · δq(x).
//
// The part λ (N − c m) · (δq(x) − Σ β_i δv_i) says that y₁ moves on its face. It is weighted by 1 − φ(|y₂ − y₁|),
// because the near-field term covers light from nearby (near_field.h).
//
// δq(x) is taken at a fixed depth, as for shadow boundaries (shadow_source.h). On an alpha edge p = Σ b_i v_i moves
// with its face; as f grows by δf, the alpha edge recedes by −N·δp = κ D δf (occluder.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "boundary/curve_source.h"
#include "estimator/view.h"
#include "secondary/occluder.h"
#include "shading/lit/near_field.h"

namespace edgegrad {

// An EdgeLine is a line past an edge or an alpha edge, of which both ends lie on faces.
struct EdgeLine {
    Occluder occluder = {};
    Vec3 w = {};                            // unit direction, world coordinates; the faces lie where N · (y − p) < 0
    int64_t segment = 0;                    // number that identifies the sampler's segment (secondary_edges.cpp)
    int32_t receiver = -1, reflector = -1;  // faces of y₁ and y₂
    Barycentrics at = {}, from = {};        // barycentrics of y₁ and y₂
    Barycentrics radiance_at =
        {};               // where the reflector's radiance is evaluated: next to y₂, if the edge lies on that face
    double share = 0;     // λ
    double distance = 0;  // |y₂ − y₁|
    double facing = 0;    // sign tells the side of the receiver's plane on which the reflector lies
};

template <class T>
class EdgeLineSource {
   public:
    using Curve = EdgeLine;

    struct Sample : CurveSample {
        EdgeLine curve;
        int32_t own;  // the receiver, which the primary ray ignores
        CurveFaces faces;
        Vec3 N, m;             // ∂F/∂y₂ / (1 − λ), and ∂F/∂v_i / β_i of the receiver
        Vec2 by_n;             // ∂F/∂n
        double by_alpha_edge;  // ∂F/∂f
        double scale;          // px² of the undistorted image per unit of the receiver's area
    };

    // `near` is the radius of the near-field term, world units.
    EdgeLineSource(const BackwardView<T>& view, double near) : view_(view), near_(near) {}

    Vec2 position(const Curve& line, double) const { return project(view_.camera, place_of(line)); }

    // Returns y₁ in camera coordinates.
    Vec3 place_of(const Curve& line) const {
        const auto v = corners_of(view_, line.receiver);
        return line.at[0] * v[0] + line.at[1] * v[1] + line.at[2] * v[2];
    }

    bool place(const Curve& line, double, Sample& sample) const {
        const Camera& camera = view_.camera;
        const auto v = corners_of(view_, line.receiver);
        const Array<Vec3>& q = view_.vertices.q;
        const Vec3 m = cross(v[1] - v[0], v[2] - v[0]), y = place_of(line);
        // A face that the viewer sees from behind is dark on both sides of the edge.
        if (!(line.facing * dot(m, camera.to_viewer(y)) > 0)) return false;

        sample.curve = line, sample.own = line.receiver;
        sample.point = y, sample.behind = {};
        const Vec3 w = camera.R * line.w;
        const auto at = [&](int32_t i) { return q[i]; };
        const Vec3 N = cross(line.occluder.sum(line.occluder.tangent, at), w);
        sample.by_alpha_edge = line.occluder.is_alpha_edge() ? line.occluder.turned(w, at) : 0;
        const double along = camera.along_ray(m, sample.n), unit_there = camera.unit_at_depth(y.z);
        const double slides = line.share * (1 - near_.share(line.distance * w));
        const Vec3 slope = slides * (N - (camera.along_ray(N, sample.n) / along) * m);
        sample.N = N, sample.m = line.share * N - slope;
        sample.by_n = {unit_there * slope.x, unit_there * slope.y};
        sample.scale = std::fabs(camera.k_det * along) / (length(m) * unit_there * unit_there);
        if (!std::isfinite(sample.scale) || !std::isfinite(dot(sample.m, sample.m))) return false;

        sample.ignored = {&sample.own, 1};
        sample.faces = CurveFaces::on(view_.scene, sample.own);
        return true;
    }

    const CurveFaces& faces_of(const Sample& sample) const { return sample.faces; }

    // Returns the receiver and the reflector. The reflector's radiance is not wanted.
    SampleSurfaces surfaces(const Sample& sample) const {
        const EdgeLine& line = sample.curve;
        return {{{line.receiver, line.at, sample.point.z}, {line.reflector, line.radiance_at, sample.point.z}}};
    }

    // Light passes where F > 0.
    CurveJumps jumps(const Sample& sample, const double* radiance) const { return {sample.weight * radiance[0], 0}; }

    Vec2 normal(const Sample& sample) const {
        return (-sample.scale * sample.area_scale) * pixel_vjp(view_.camera, sample.n, sample.by_n);
    }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const EdgeLine& line = sample.curve;
        const auto moved = [&](int32_t face, Barycentrics b) {
            const int32_t* vertex = view_.scene.faces + 3 * int64_t(face);
            return b[0] * direction.q[vertex[0]] + b[1] * direction.q[vertex[1]] + b[2] * direction.q[vertex[2]];
        };
        const Vec3 p = line.occluder.sum(line.occluder.weight, [&](int32_t i) { return direction.q[i]; });
        const Vec2 n_dot = normalised_jvp(view_.camera, sample.n, direction.intrinsics);
        const double F_dot = dot(sample.m, moved(line.receiver, line.at)) +
                             dot(sample.N, (1 - line.share) * moved(line.reflector, line.from) - p) +
                             sample.by_alpha_edge * line.occluder.alpha_edge_jvp(direction.tangents) +
                             sample.by_n.x * n_dot.x + sample.by_n.y * n_dot.y;
        return {sample.scale * sample.area_scale * F_dot, 0};
    }

    void add_motion(const Sample& sample, CurveJumps jumps, LocalGradients& grad) const {
        const EdgeLine& line = sample.curve;
        const double F_bar = sample.scale * sample.area_scale * jumps.first;
        const auto add = [&](int32_t vertex, Vec3 bar) { grad.q.add<3>(vertex, &bar.x); };
        for (int i = 0; i < 3; ++i) {
            add(view_.scene.faces[3 * int64_t(line.receiver) + i], (F_bar * line.at[i]) * sample.m);
            add(view_.scene.faces[3 * int64_t(line.reflector) + i],
                (F_bar * (1 - line.share) * line.from[i]) * sample.N);
        }
        const Occluder& occluder = line.occluder;
        for (int i = 0; i < occluder.count; ++i) add(occluder.vertex[i], (-F_bar * occluder.weight[i]) * sample.N);
        occluder.alpha_edge_vjp(F_bar * sample.by_alpha_edge, grad);
        normalised_vjp(view_.camera, sample.n, F_bar * sample.by_n, grad.k);
    }

    void cast() {}
    void finish(LocalGradients&) {}

   private:
    const BackwardView<T>& view_;
    const NearField near_;
};

}  // namespace edgegrad
