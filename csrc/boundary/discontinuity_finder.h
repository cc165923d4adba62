// This file finds where lines across the image meet discontinuities within a face: alpha edges, or borders between
// nearest texels.
//
// Along a line in the image the barycentrics of a face are (P_a + t (P_b − P_a)) / w, with P and w affine (FaceMap).
// With τ = t w_b / ((1 − t) w_a + t w_b) they are affine in τ, and so are texture coordinates. A segment of the line
// then runs straight through the cells of the texture (Amanatides and Woo 1987). In a cell of four texels a bilinear α
// is a polynomial of degree 2 in τ. Its zeros are known in closed form, so none is missed.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "core/sampler.h"
#include "estimator/view.h"
#include "shading/shade.h"

namespace edgegrad {

// A DiscontinuityCrossing is where a line across a face meets a discontinuity F = 0, at u in the undistorted image. F
// is affine in the texture coordinates near there. An alpha-tested face is opaque where F > 0.
struct DiscontinuityCrossing {
    int32_t face = -1;
    bool is_alpha_edge = false;  // whether it is an alpha edge; else a texel edge
    bool vertical = false;       // whether the line is vertical
    Vec2 u;
    Vec2 slope;            // ∂F/∂uv
    double side = 0;       // F on the two sides of a texel edge, ±; 0: F is α minus the cutoff
    Footprint alpha = {};  // texels and weights of F, where it is bilinear
};

// Calls visit(i, j, from, to) for up to `most` cells of a unit grid that a + τ d passes, τ = first to last.
template <class Visit>
void each_cell(Vec2 a, Vec2 d, double first, double last, int most, Visit visit) {
    double i = std::floor(a.x + first * d.x), j = std::floor(a.y + first * d.y);
    const auto next = [](double cell, double a, double d) {
        if (d == 0) return std::numeric_limits<double>::infinity();
        return ((d > 0 ? cell + 1 : cell) - a) / d;
    };
    for (double from = first; most-- > 0;) {
        const double at_i = next(i, a.x, d.x), at_j = next(j, a.y, d.y);
        const double to = std::clamp(std::min(at_i, at_j), from, last);
        visit(i, j, from, to);
        if (!(to < last)) return;
        if (at_i <= at_j) i += d.x > 0 ? 1 : -1;
        else j += d.y > 0 ? 1 : -1;
        from = to;
    }
}

// Calls visit(t) for the t in [0, 1] where c0 + c1 t + c2 t² changes between < 0 and ≥ 0. Values up to `rounding` count
// as zero. Two faces, or two cells, then agree on a zero on their common border, and one of them has it.
template <class Visit>
void each_sign_change(double c0, double c1, double c2, double rounding, Visit visit) {
    const auto at = [&](double t) {
        const double value = c0 + t * (c1 + t * c2);
        return std::fabs(value) <= rounding ? 0 : value;
    };
    const double turn = c2 != 0 ? -c1 / (2 * c2) : -1;
    double from = 0;
    for (const double to : {turn > 0 && turn < 1 ? turn : 0.0, 1.0}) {
        if (!(to > from)) continue;
        if ((at(from) >= 0) != (at(to) >= 0)) {
            // Takes the root in between, in the form that does not cancel.
            const double root = std::sqrt(std::max(0.0, c1 * c1 - 4 * c2 * c0));
            const double q = -0.5 * (c1 + (c1 > 0 ? root : -root));
            const double r0 = q != 0 ? c0 / q : from, r1 = c2 != 0 ? q / c2 : r0;
            const auto outside = [&](double r) { return std::max(from - r, r - to); };
            visit(std::clamp(!(outside(r1) < outside(r0)) ? r0 : r1, from, to));
        }
        from = to;
    }
}

template <class T>
class DiscontinuityFinder {
   public:
    explicit DiscontinuityFinder(const BackwardView<T>& view) : view_(view) {}

    // Returns whether there may be discontinuities in a face.
    static bool may_have_discontinuities(const SceneView<T>& scene, int64_t face) {
        return scene.alpha_masks.on(face) || takes_nearest(scene, face);
    }

    // Selects the face for find().
    void set(int32_t face) {
        if (face == face_) return;
        face_ = face;
        const auto corner = corners_of(view_, face);
        map_ = face_map(view_.camera, corner.data());
        front_ = side_of(view_, face) == 1 ? -1 : 1;
    }

    // Calls visit(crossing, weight) for the discontinuities on the segment from a to b of a line of the undistorted
    // image, where it lies on the face. If it passes more than `most` texture cells, `random` draws that many to stand
    // for all.
    template <class Visit>
    void find(Vec2 a, Vec2 b, bool vertical, int most, uint64_t random, Visit visit) const {
        Segment s;
        if (!clip(a, b, s)) return;
        DiscontinuityCrossing crossing{
            .face = face_, .is_alpha_edge = false, .vertical = vertical, .u = {}, .slope = {}};
        const auto at = [&](double tau) {
            const double t = tau * s.w[0] / ((1 - tau) * s.w[1] + tau * s.w[0]);
            crossing.u = s.u[0] + t * (s.u[1] - s.u[0]);
        };
        const SceneView<T>& scene = view_.scene;
        if (is_textured(scene, face_)) {
            const Texture<T> texture = texture_of(scene, face_);
            const int C = scene.radiance;
            const auto differ = [&](int64_t m, int64_t n) {
                const T *p = texture.texels + m * C, *q = texture.texels + n * C;
                return m != n && !std::equal(p, p + C, q);
            };
            if (texture.sampler.filter == TextureFilter::nearest)
                each_texel_edge(texture, s, most, hash(random, 1), [&](const TexelEdgeCrossing& edge) {
                    if (!differ(edge.low, edge.high)) return;
                    at(edge.tau), crossing.slope = edge.slope, crossing.side = edge.side;
                    visit(crossing, edge.weight);
                });
        }
        if (!scene.alpha_masks.on(face_)) return;
        crossing.is_alpha_edge = true;
        const Texture<T> alpha = alpha_of(scene, face_);
        const double cutoff = cutoff_of(scene, face_);
        if (alpha.sampler.filter == TextureFilter::nearest) {
            each_texel_edge(alpha, s, most, hash(random, 2), [&](const TexelEdgeCrossing& edge) {
                const bool low = alpha.texels[edge.low] >= cutoff, high = alpha.texels[edge.high] >= cutoff;
                if (low == high) return;
                at(edge.tau), crossing.slope = (high ? 1.0 : -1.0) * edge.slope, crossing.side = edge.side;
                visit(crossing, edge.weight);
            });
            return;
        }
        const Walk walk = walk_of(alpha, s, {0.5, 0.5}, most, hash(random, 2));
        each_cell(walk.a, walk.d, walk.first, walk.last, walk.most, [&](double i, double j, double from, double to) {
            const double x = walk.a.x + from * walk.d.x - i, y = walk.a.y + from * walk.d.y - j;
            Footprint f = footprint_at(alpha, i, j, x, y);
            const auto texel = [&](int k) { return double(alpha.texels[f.texel[k]]) - cutoff; };
            const double t0 = texel(0), t1 = texel(1), t2 = texel(2), t3 = texel(3);
            if (std::min({t0, t1, t2, t3}) > 0 || std::max({t0, t1, t2, t3}) < 0) return;
            // Evaluates t0 + x by_x + y by_y + x y both along x + t dx, y + t dy.
            const double by_x = t1 - t0, by_y = t2 - t0, both = t0 - t1 - t2 + t3;
            const double dx = (to - from) * walk.d.x, dy = (to - from) * walk.d.y;
            const double rounding =
                1e-12 * (std::fabs(t0) + std::fabs(t1) + std::fabs(t2) + std::fabs(t3) + std::fabs(cutoff));
            each_sign_change(t0 + x * by_x + y * by_y + x * y * both, dx * by_x + dy * by_y + (x * dy + y * dx) * both,
                             dx * dy * both, rounding, [&](double t) {
                                 constexpr double one = 1;
                                 f.a = x + t * dx, f.b = y + t * dy;
                                 at(from + t * (to - from));
                                 crossing.alpha = f, crossing.slope = eval_vjp<1>(alpha, f, 1, &one);
                                 visit(crossing, walk.weight);
                             });
        });
    }

   private:
    // A Segment is the part of a line on the face: positions, texture coordinates and depth weights w of its ends.
    struct Segment {
        Vec2 u[2], uv[2];
        double w[2];
    };
    bool clip(Vec2 a, Vec2 b, Segment& s) const {
        const Vec3 p = map_.times(normalised(view_.camera, a)), q = map_.times(normalised(view_.camera, b));
        double first = 0, last = 1;
        const auto keep = [&](double at_a, double at_b) {  // keeps where the value is not negative
            at_a *= front_, at_b *= front_;
            if (at_a < 0 && at_b < 0) last = -1;
            else if (at_a < 0) first = std::max(first, at_a / (at_a - at_b));
            else if (at_b < 0) last = std::min(last, at_a / (at_a - at_b));
        };
        keep(p.x, q.x), keep(p.y, q.y), keep(p.z - p.x - p.y, q.z - q.x - q.y);
        if (!(last > first)) return false;
        for (int k = 0; k < 2; ++k) {
            const double t = k ? last : first;
            const Vec3 at = (1 - t) * p + t * q;
            s.u[k] = (1 - t) * a + t * b, s.w[k] = at.z;
            s.uv[k] = interpolated_uv(view_.scene, face_, inside({at.x / at.z, at.y / at.z}));
            if (!std::isfinite(s.uv[k].x + s.uv[k].y)) return false;
        }
        return true;
    }

    // A Walk is the visited part of a segment: a + τ d in cells.
    struct Walk {
        Vec2 a, d;
        double first = 0, last = 1, weight = 1;
        int most;
    };
    Walk walk_of(const Texture<T>& texture, const Segment& s, Vec2 origin, int most, uint64_t random) const {
        const Vec2 a = texture.place(s.uv[0]) - origin, b = texture.place(s.uv[1]) - origin;
        Walk walk{.a = a, .d = b - a, .most = most + 4};
        const double parts = std::ceil((std::fabs(walk.d.x) + std::fabs(walk.d.y)) / most);
        if (parts > 1) {
            walk.first = std::floor(to_unit(random) * parts) / parts, walk.last = walk.first + 1 / parts;
            walk.weight = parts;
        }
        return walk;
    }

    // A TexelEdgeCrossing is where the segment crosses a texel edge.
    struct TexelEdgeCrossing {
        double tau, weight;
        int64_t low, high;  // texels on the side of the lower and higher coordinate
        Vec2 slope;         // derivative of that coordinate minus the border's, by uv
        double side;        // motion that is needed to be well within a texel
    };
    template <class Visit>
    void each_texel_edge(const Texture<T>& texture, const Segment& s, int most, uint64_t random, Visit visit) const {
        const Walk walk = walk_of(texture, s, {}, most, random);
        double last_i = 0, last_j = 0;
        bool begun = false;
        each_cell(walk.a, walk.d, walk.first, walk.last, walk.most, [&](double i, double j, double from, double) {
            // A border along an edge of the face is a crease (lies_between_texels). Rounding must not find it again.
            constexpr double rounding = 1e-9;
            if (begun && from > rounding && from < 1 - rounding) {
                const bool across = i != last_i, up = i + j > last_i + last_j;
                const int64_t here = texel_at(texture, i, j).texel[0],
                              before = texel_at(texture, last_i, last_j).texel[0];
                const double place = std::fabs(across ? i : j);
                visit(TexelEdgeCrossing{
                    .tau = from,
                    .weight = walk.weight,
                    .low = up ? before : here,
                    .high = up ? here : before,
                    .slope = across ? Vec2{double(texture.width), 0} : Vec2{0, -double(texture.height)},
                    .side = 0x1p-20 + 0x1p-44 * place});
            }
            begun = true, last_i = i, last_j = j;
        });
    }

    const BackwardView<T>& view_;
    int32_t face_ = -1;
    FaceMap map_;
    double front_ = 1;  // sign of w where the face is seen
};

}  // namespace edgegrad
