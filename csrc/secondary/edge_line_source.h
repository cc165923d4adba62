// Borders of what surfaces see of one another, as a source of curves: an edge (a, b), or an alpha edge, on the
// line between two points of a path of light, y₁ that is seen in the image and y₂ that sends light to it.
//
// In place of a light there is a surface of the scene, so that one border in the image has no one place: for each point
// of the edge and each line past it there is another. Lines are drawn by the point p = (1 − t) a + t b and the unit
// direction w, in the wedge on which the faces of the edge lie where N · (y − p) < 0, N = (b − a) × w. A line that is
// moved by h along N / |N| passes the faces if h > 0, and |N| dh dt dω is the measure of lines, cos θ₁ cos θ₂ / r² dA₁
// dA₂ at its ends: so the border's share of ∂loss/∂Φ is
//
//     ∫∫ Ã |dx/dA₁| V f₁ L₂ δF dt dω,    F = N · (λ y₁ + (1 − λ) y₂ − p),    λ = |y₂ − p| / (|y₁ − p| + |y₂ − p|)
//
// with f₁ L₂ what y₁ scatters to the viewer of what y₂ sends, and V whether the viewer sees y₁. The place of y₁ in the
// image is fixed, y₂ and p stay at their places on face and edge: along the ray r = dq/dz of the camera, with the
// normal m of the face of y₁, c = N·r / m·r, and barycentrics β and γ of y₁ and y₂,
//
//     δF = λ c m · Σ β_i δv_i + (1 − λ) N · Σ γ_i δv_i − N · ((1 − t) δa + t δb) + λ (N − c m) · δq(x),
//
// of which λ (N − c m) · (δq(x) − Σ β_i δv_i) is that y₁ slides on its face. That part counts as far as light does not
// come from nearby, times 1 − φ(|y₂ − y₁|): sliding before what is near is found otherwise (near_field.h).
//
// δq(x) at a fixed depth, as for borders of shadows (shadow_source.h). On an alpha edge p = Σ b_i v_i moves with its
// face and, as f grows by δf, gives way by −N·δp = κ D δf (occluder.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "boundary/curve_source.h"
#include "estimator/view.h"
#include "secondary/occluder.h"
#include "shading/lit/near_field.h"

namespace edgegrad {

// A line past an edge or an alpha edge, of which both ends lie on faces.
struct EdgeLine {
    Occluder occluder = {};
    Vec3 w = {};                            // unit, world coordinates; the faces lie where N · (y − p) < 0
    int64_t segment = 0;                    // of the sampler (secondary_edges.cpp)
    int32_t receiver = -1, reflector = -1;  // the faces of y₁ and y₂
    Barycentrics at = {}, from = {};        // y₁ and y₂ on them
    Barycentrics asked = {};  // where the reflector's radiance is asked: next to y₂, if the edge lies on that face
    double share = 0;         // λ
    double distance = 0;      // |y₂ − y₁|
    double facing = 0;        // on which side of the receiver's plane the reflector is
};

template <class T>
class EdgeLineSource {
   public:
    using Curve = EdgeLine;

    struct Sample : CurveSample {
        EdgeLine line;
        int32_t own;  // the receiver, which the ray ignores
        CurveFaces faces;
        Vec3 N, m;             // ∂F/∂y₂ / (1 − λ), and ∂F/∂v_i / β_i of the receiver
        Vec2 by_n;             // ∂F/∂n
        double by_alpha_edge;  // ∂F/∂f
        double scale;          // px² of the undistorted image for each unit of the receiver's area
    };

    // near  the radius of what slides are found of otherwise, world units
    EdgeLineSource(const BackwardView<T>& view, double near) : view_(view), near_(near) {}

    Vec2 position(const Curve& line, double) const { return project(view_.camera, place_of(line)); }

    // In camera coordinates.
    Vec3 place_of(const Curve& line) const {
        const auto v = corners_of(view_, line.receiver);
        return line.at[0] * v[0] + line.at[1] * v[1] + line.at[2] * v[2];
    }

    bool place(const Curve& line, double, Sample& sample) const {
        const Camera& camera = view_.camera;
        const auto v = corners_of(view_, line.receiver);
        const Array<Vec3>& q = view_.vertices.q;
        const Vec3 m = cross(v[1] - v[0], v[2] - v[0]), y = place_of(line);
        // What the viewer sees from behind is dark on both sides of the border.
        if (!(line.facing * dot(m, camera.to_viewer(y)) > 0)) return false;

        sample.line = line, sample.own = line.receiver;
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

    // The receiver, and, of which no radiance is wanted, the reflector.
    SampleSurfaces surfaces(const Sample& sample) const {
        const EdgeLine& line = sample.line;
        return {{{line.receiver, line.at, sample.point.z}, {line.reflector, line.asked, sample.point.z}}};
    }

    // Light passes where F > 0.
    CurveJumps jumps(const Sample& sample, const double* radiance) const { return {sample.weight * radiance[0], 0}; }

    Vec2 normal(const Sample& sample) const {
        return (-sample.scale * sample.area_scale) * pixel_vjp(view_.camera, sample.n, sample.by_n);
    }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const EdgeLine& line = sample.line;
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
        const EdgeLine& line = sample.line;
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
