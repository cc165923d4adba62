// This file holds the curve source of shadow boundaries.
//
// A point l of a light and an edge (a, b) span the shadow plane. Its normal is N = (b − a) × d. d = p − l runs from the
// light to the point p of the edge. For a light at infinity it runs along the rays. The boundary lies where this plane
// meets a face, the receiver, with the normal m through v_i. Let y(x) be the point of the receiver seen at x. Then
//
//     F(x) = N · (y(x) − p)
//
// is zero there, and the boundary contributes ∫ Ã [L(F > 0) − L(F < 0)] δF / |∇F| dℓ to ∂loss/∂Φ. Let r = dq/dz be the
// camera's ray, c = N·r / m·r, β the barycentrics of y, and y = w_a a + w_b b + w_l l on the shadow plane. Then
//
//     δF = c m · Σ β_i δv_i − N · (w_a δa + w_b δb + w_l δl) + (N − c m) · δq(x),
//
// with δq(x) at a fixed depth. The last factor is also ∇F, by the position in the image. Per unit of t on the edge the
// boundary has the length |y′| with y′ = S / (m·d) · m × N. S = |y − l| / |p − l|, or 1 if the light is at infinity.
// The position on the edge therefore only decides where the ray goes. A light at infinity moves by the direction
// towards it. An alpha edge uses its tangent in place of b − a (occluder.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "boundary/curve_source.h"
#include "estimator/view.h"
#include "secondary/occluder.h"

namespace edgegrad {

// A ShadowPoint is where the ray of a light past an edge or an alpha edge meets a face.
struct ShadowPoint {
    Occluder caster;
    int32_t part;         // part of the light
    Vec2 uv;              // position on that part
    Vec3 light;           // point of the light, world coordinates, or the direction towards it
    int side;             // dark side as seen from the light: 1: the side of dp/dt × (p − l), or −1
    int32_t face = -1;    // the receiver
    int64_t segment = 0;  // number that identifies the sampler's interval (shadows.cpp)
    Barycentrics on{};    // barycentrics on the receiver
    double along = 0;     // y = l + along · d; for a light at infinity, p + along · d
};

// ShadowBorder holds the derivatives of F, in the coordinate system of the given vertices and light.
struct ShadowBorder {
    Vec3 N, d;
    double S;
    double by_caster[3] = {}, by_light;  // weights of its vertices, and of the light
    double by_alpha_edge = 0;            // ∂F/∂f

    // Builds the border. at(i) returns a vertex; `light` is its point, or the direction towards it.
    template <class At>
    static ShadowBorder of(const ShadowPoint& point, bool infinite, Vec3 light, At at) {
        const Occluder& caster = point.caster;
        const Vec3 p = caster.sum(caster.weight, at), along = caster.sum(caster.tangent, at);
        ShadowBorder o;
        o.d = infinite ? -light : p - light, o.N = cross(along, o.d), o.S = infinite ? 1 : point.along;
        for (int i = 0; i < caster.count; ++i) o.by_caster[i] = o.S * caster.weight[i];
        o.by_light = infinite ? -point.along : 1 - point.along;
        if (caster.is_alpha_edge()) o.by_alpha_edge = o.S * caster.turned(o.d, at);
        return o;
    }
    // Returns the area swept as the occluder moves by a unit length along N. `most` is the area per unit of F.
    double swept(double most, const Occluder& caster) const {
        double sum = by_caster[0] + by_caster[1];
        if (caster.is_alpha_edge()) sum += by_caster[2];
        return most * sum * length(N);
    }
};

template <class T>
class ShadowSource {
   public:
    using Curve = ShadowPoint;

    struct Sample : CurveSample {
        ShadowPoint curve;
        int32_t receiver;  // face that the primary ray ignores
        CurveFaces faces;
        ShadowBorder border;
        Vec3 m;          // normal of the receiver times c
        Vec2 by_n;       // ∂F/∂n
        double speed;    // |du/dt|, px of the undistorted image
        double scale;    // `speed` over |∇F|
        bool lit_ahead;  // whether the lit side is where F > 0
    };

    ShadowSource(const BackwardView<T>& view, bool infinite) : view_(view), infinite_(infinite) {}

    Vec2 position(const Curve& curve, double) const { return project(view_.camera, place_of(curve)); }

    // Returns y in camera coordinates.
    Vec3 place_of(const Curve& curve) const {
        const auto v = corners_of(view_, curve.face);
        return curve.on[0] * v[0] + curve.on[1] * v[1] + curve.on[2] * v[2];
    }

    Vec3 light_of(const Curve& curve) const {
        return infinite_ ? view_.camera.R * curve.light : view_.camera.to_camera(curve.light);
    }

    bool place(const Curve& curve, double, Sample& sample) const {
        const Camera& camera = view_.camera;
        const auto v = corners_of(view_, curve.face);
        const ShadowBorder border = ShadowBorder::of(curve, infinite_, light_of(curve), vertices());
        const Vec3 m = cross(v[1] - v[0], v[2] - v[0]), y = place_of(curve), d = border.d, N = border.N;
        // A face that is lit from behind is dark on both sides of the boundary.
        if (!(dot(m, d) * dot(m, camera.view_direction(y)) > 0)) return false;

        sample.curve = curve, sample.receiver = curve.face;
        sample.point = y, sample.behind = {};
        sample.border = border, sample.m = (camera.along_ray(N, sample.n) / camera.along_ray(m, sample.n)) * m;
        const Vec3 slope = camera.unit_at_depth(y.z) * (N - sample.m);
        sample.by_n = {slope.x, slope.y};
        const Vec3 moved = (border.S / dot(m, d)) * cross(m, N);
        const double w = 1 / camera.depth_weight(y),
                     w_dot = camera.projection([&](auto c) { return c.weight_jvp(moved); });
        sample.speed =
            length(scaled_to_pixels(camera, {(moved.x - w_dot * sample.n.x) * w, (moved.y - w_dot * sample.n.y) * w}));
        sample.scale = sample.speed / length(place_vjp(camera, sample.by_n));
        sample.lit_ahead = curve.side < 0;
        if (!std::isfinite(sample.scale)) return false;
        // The ray is moved to the dark side: see BackwardView::curve_offset.
        const Vec2 by_u = place_vjp(camera, sample.by_n);
        const double moved_by = (sample.lit_ahead ? -1 : 1) * view_.curve_offset / length(by_u);
        sample.sight = normalised(camera, sample.u + moved_by * by_u);

        sample.ignored = {&sample.receiver, 1};
        sample.faces = CurveFaces::on(view_.scene, sample.receiver);
        return true;
    }

    const CurveFaces& faces_of(const Sample& sample) const { return sample.faces; }

    // Returns the receiver twice: lit, and in shadow.
    SampleSurfaces surfaces(const Sample& sample) const {
        const SurfacePoint there{sample.receiver, sample.curve.on, sample.point.z};
        return {{there, there}};
    }

    CurveJumps jumps(const Sample& sample, const double* radiance) const {
        return {(sample.lit_ahead ? 1 : -1) * sample.weight * (radiance[0] - radiance[1]), 0};
    }

    // The curve moves with δx as F does with −δx.
    Vec2 normal(const Sample& sample) const {
        return (-sample.scale * sample.area_scale) * pixel_vjp(view_.camera, sample.n, sample.by_n);
    }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        if (!direction.moves()) return {};
        const int32_t* vertex = view_.scene.faces + 3 * int64_t(sample.receiver);
        Vec3 receiver;
        for (int i = 0; i < 3; ++i) receiver += sample.curve.on[i] * direction.q[vertex[i]];
        const Occluder& edge = sample.curve.caster;
        const Vec3 caster = edge.sum(sample.border.by_caster, [&](int32_t i) { return direction.q[i]; });
        const Vec2 n_dot = normalised_jvp(view_.camera, sample.n, direction.intrinsics);
        double F_dot =
            dot(sample.m, receiver) - dot(sample.border.N, caster) + sample.by_n.x * n_dot.x + sample.by_n.y * n_dot.y;
        F_dot += sample.border.by_alpha_edge * edge.alpha_edge_jvp(direction.tangents);
        return {sample.scale * sample.area_scale * F_dot, 0};
    }

    void add_motion(const Sample& sample, CurveJumps jumps, LocalGradients& grad) const {
        const double F_bar = sample.scale * sample.area_scale * jumps.first;
        const int32_t* vertex = view_.scene.faces + 3 * int64_t(sample.receiver);
        for (int i = 0; i < 3; ++i) {
            const Vec3 bar = (F_bar * sample.curve.on[i]) * sample.m;
            grad.q.add<3>(vertex[i], &bar.x);
        }
        const Occluder& caster = sample.curve.caster;
        for (int i = 0; i < caster.count; ++i) {
            const Vec3 bar = (-F_bar * sample.border.by_caster[i]) * sample.border.N;
            grad.q.add<3>(caster.vertex[i], &bar.x);
        }
        caster.alpha_edge_vjp(F_bar * sample.border.by_alpha_edge, grad);
        grad.light = {sample.curve.part, sample.curve.uv, (-F_bar * sample.border.by_light) * sample.border.N};
        normalised_vjp(view_.camera, sample.n, F_bar * sample.by_n, grad.k);
    }

    void cast() {}
    void finish(LocalGradients&) {}

   private:
    // Returns vertices in camera coordinates.
    auto vertices() const {
        return [&](int32_t i) { return view_.vertices.q[i]; };
    }

    const BackwardView<T>& view_;
    const bool infinite_;
};

}  // namespace edgegrad
