// This file holds the curve source of discontinuities within faces: alpha edges, and texel edges of nearest lookups.
//
// Lines at a spacing Δ, horizontal and vertical, meet the curve F = 0 in points (Crofton). Each family has one random
// shift. With n = ∇F / |∇F|, the sum
//
//     Σ_vertical Δ |n_y| g + Σ_horizontal Δ |n_x| g,     g = Ã [L(F > 0) − L(F < 0)] δF / |∇F|,
//
// has the mean ∫ g dℓ, because a horizontal line meets a piece dℓ with the probability |n_x| dℓ / Δ. δF is taken at
// fixed x:
//
//     δF = ∂F/∂uv · (Σ b_i δuv_i + Σ δb_i uv_i) + Σ_k weight_k δα_k,
//
// with the barycentrics b as functions of vertices and camera (camera/face_map.h).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "boundary/curve_source.h"
#include "boundary/discontinuity_finder.h"
#include "estimator/view.h"

namespace edgegrad {

template <class T>
class DiscontinuitySource {
   public:
    using Curve = DiscontinuityCrossing;

    struct Sample : CurveSample {
        DiscontinuityCrossing crossing;
        int32_t face;  // face that the ray ignores
        CurveFaces faces;
        FaceMap map;
        Barycentrics b, side[2], slope;  // `slope` is ∂F/∂b
        Vec2 by_n;                       // ∂F/∂n
        double scale;                    // |n_x| / |∇F| or |n_y| / |∇F|, in the undistorted image
    };

    explicit DiscontinuitySource(const BackwardView<T>& view) : view_(view) {}

    Vec2 position(const Curve& curve, double) const { return curve.u; }

    bool place(const Curve& curve, double, Sample& sample) const {
        const auto corner = corners_of(view_, curve.face);
        sample.crossing = curve, sample.face = curve.face;
        sample.map = face_map(view_.camera, corner.data());
        sample.b = barycentrics_of_hit(sample.map, sample.n);
        const Vec2 uv0 = uv(curve.face, 0), e1 = uv(curve.face, 1) - uv0, e2 = uv(curve.face, 2) - uv0;
        const Barycentrics slope = sample.slope = {dot(curve.slope, e1), dot(curve.slope, e2)};
        FaceMap unused;
        sample.by_n = {};
        barycentrics_vjp(sample.map, sample.n, sample.b, slope, unused, sample.by_n);
        const Vec2 gradient = place_vjp(view_.camera, sample.by_n);
        const double squared = gradient.x * gradient.x + gradient.y * gradient.y;
        sample.scale = std::fabs(curve.vertical ? gradient.y : gradient.x) / squared;
        if (!std::isfinite(sample.scale)) return false;
        for (int k = 0; k < 2; ++k) {
            const double moved = (k ? -curve.side : curve.side) / (slope.u * slope.u + slope.v * slope.v);
            sample.side[k] = {sample.b.u + moved * slope.u, sample.b.v + moved * slope.v};
        }
        if (curve.is_alpha_edge) {
            // The ray passes on the masked side. A neighbour with the same alpha edge on a common edge is masked, too.
            constexpr double aside = 1e-6;  // px
            sample.sight = normalised(view_.camera, curve.u + (-aside / std::sqrt(squared)) * gradient);
        } else {
            // Texels cause a jump only where the face is opaque on both sides of their border.
            for (const Barycentrics& side : sample.side)
                if (!shows(view_.scene, curve.face, side)) return false;
        }
        sample.point = sample.b[0] * corner[0] + sample.b[1] * corner[1] + sample.b[2] * corner[2];
        sample.behind = {};
        sample.ignored = {&sample.face, 1};
        sample.faces = CurveFaces::on(view_.scene, sample.face);
        return true;
    }

    const CurveFaces& faces_of(const Sample& sample) const { return sample.faces; }

    SampleSurfaces surfaces(const Sample& sample) const {
        const SurfacePoint there{sample.face, sample.side[0], sample.point.z};
        if (sample.crossing.is_alpha_edge) return {{there, sample.behind}};
        return {{there, {sample.face, sample.side[1], sample.point.z}}};
    }

    CurveJumps jumps(const Sample& sample, const double* radiance) const {
        return {sample.weight * (radiance[0] - radiance[1]), 0};
    }

    // The curve moves with δx as F does with −δx.
    Vec2 normal(const Sample& sample) const {
        return (-sample.scale * sample.area_scale) * pixel_vjp(view_.camera, sample.n, sample.by_n);
    }

    CurveJumps velocities(const Sample& sample, const Direction& direction) const {
        const DiscontinuityCrossing& crossing = sample.crossing;
        double F_dot = 0;
        if (direction.moves()) {
            const auto corner = corners_of(view_, sample.face);
            Vec3 corner_dot[3];
            for (int i = 0; i < 3; ++i) corner_dot[i] = direction.q[vertex_of(sample.face, i)];
            const Barycentrics b_dot =
                barycentrics_jvp(sample.map, sample.n, sample.b, face_map_jvp(view_.camera, corner.data(), corner_dot),
                                 normalised_jvp(view_.camera, sample.n, direction.intrinsics));
            F_dot += sample.slope.u * b_dot.u + sample.slope.v * b_dot.v;
        }
        if (const double* uvs = direction.tangents.uvs)
            for (int i = 0; i < 3; ++i) {
                const double* uv_dot = uvs + 2 * int64_t(uv_row(sample.face, i));
                F_dot += sample.b[i] * (crossing.slope.x * uv_dot[0] + crossing.slope.y * uv_dot[1]);
            }
        if (const double* alphas = direction.tangents.alphas; alphas && is_of_alpha(crossing))
            for (int k = 0; k < 4; ++k) F_dot += crossing.alpha.weight(k) * alphas[crossing.alpha.texel[k]];
        return {sample.scale * sample.area_scale * F_dot, 0};
    }

    void add_motion(const Sample& sample, CurveJumps jumps, LocalGradients& grad) const {
        const DiscontinuityCrossing& crossing = sample.crossing;
        const double F_bar = sample.scale * sample.area_scale * jumps.first;
        if (grad.q.is_wanted()) {
            const auto corner = corners_of(view_, sample.face);
            FaceMap map_bar;
            Vec2 n_bar;
            Vec3 corner_bar[3];
            barycentrics_vjp(sample.map, sample.n, sample.b, {F_bar * sample.slope.u, F_bar * sample.slope.v}, map_bar,
                             n_bar);
            normalised_vjp(view_.camera, sample.n, n_bar, grad.k);
            face_map_vjp(view_.camera, corner.data(), map_bar, corner_bar);
            for (int i = 0; i < 3; ++i) grad.q.add<3>(vertex_of(sample.face, i), &corner_bar[i].x);
        }
        if (grad.uvs.is_wanted())
            for (int i = 0; i < 3; ++i) {
                const Vec2 uv_bar = (F_bar * sample.b[i]) * crossing.slope;
                grad.uvs.add<2>(uv_row(sample.face, i), &uv_bar.x);
            }
        if (grad.alphas.is_wanted() && is_of_alpha(crossing))
            for (int k = 0; k < 4; ++k) {
                const double alpha_bar = F_bar * crossing.alpha.weight(k);
                grad.alphas.add<1>(crossing.alpha.texel[k], &alpha_bar);
            }
    }

    void cast() {}
    void finish(LocalGradients&) {}

   private:
    static double dot(Vec2 a, Vec2 b) { return a.x * b.x + a.y * b.y; }
    static bool is_of_alpha(const DiscontinuityCrossing& c) { return c.is_alpha_edge && c.side == 0; }
    int32_t vertex_of(int32_t face, int corner) const { return view_.scene.faces[3 * int64_t(face) + corner]; }
    int32_t uv_row(int32_t face, int corner) const { return view_.scene.uv_corners[3 * int64_t(face) + corner]; }
    Vec2 uv(int32_t face, int corner) const {
        const double* p = view_.scene.uvs + 2 * int64_t(uv_row(face, corner));
        return {p[0], p[1]};
    }

    const BackwardView<T>& view_;
};

}  // namespace edgegrad
