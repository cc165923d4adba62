// This file classifies whole faces by what the image shows of them. On a mesh with a colour per face every edge is a
// crease. Nearly all of these lie between two faces that are wholly hidden or wholly visible, and need no further test.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "boundary/curve.h"
#include "estimator/view.h"
#include "primary/crease_visibility.h"
#include "primary/overlapping_parts.h"
#include "primary/silhouette_grid.h"
#include "scene/contact.h"

namespace edgegrad {

struct CreaseFace {
    // `turned`: the face is on the back of a closed mesh. `hidden`: in addition no silhouette passes before it, or it
    // lies behind all hits around it. `clear`: it lies amid hits, and no silhouette passes before it. `seen`: in
    // addition it was hit itself. `unknown`: none of these.
    enum State : uint8_t { unknown, turned, hidden, clear, seen };
    float value;       // faces with different values differ along their common edge; NaN: unknown
    float pixels;      // measure of a crease next to a hidden or turned face, without the adjoint
    float importance;  // mean |A| in its box
    State state;

    bool is_hidden() const { return state == turned || state == hidden; }
};

template <class T>
class CreaseFaces {
   public:
    CreaseFaces(const BackwardView<T>& view, const CurveFinder<T>& finder, const SilhouetteGrid& silhouette_grid,
                const OverlappingParts& overlapping_parts)
        : view_(view),
          finder_(finder),
          silhouette_grid_(silhouette_grid),
          overlapping_parts_(overlapping_parts),
          faces_(view.scene.n_faces),
          density_of_hidden_(
              view.occlusion.factor(CreaseSamples::hidden, OcclusionHint::pixels_around, view.image.spp)) {
        set_bounds();
        view.team.parallel_for_blocks(view.scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            constexpr int64_t ahead = 16;
            for (int64_t f = first; f < last; ++f) {
                if (f + ahead < last)
                    for (int i = 0; i < 3; ++i) {
                        const int32_t v = view.scene.faces[3 * (f + ahead) + i];
                        prefetch(&view.vertices.x[v]), prefetch(&view.vertices.q[v].z);
                    }
                faces_[f] = look_at(f);
            }
        });
    }

    const CreaseFace& operator[](int64_t face) const { return faces_[face]; }

   private:
    CreaseFace look_at(int64_t f) const {
        CreaseFace out{value_of(f), 0, 0, CreaseFace::unknown};
        const int32_t* v = view_.scene.faces + 3 * f;
        const VertexView& p = view_.vertices;
        if ((p.outcode[v[0]] | p.outcode[v[1]] | p.outcode[v[2]]) || is_textured(view_.scene, f)) return out;
        const ImageHits& hits = *view_.hits;
        const bool behind = hits.are_behind(v);
        const ImageHits::FaceHits hit = hits.of(v);
        if (!behind && hit.partly && !hit.clear && !hit.missed) return out;

        const Vec2 a = p.x[v[0]], b = p.x[v[1]], c = p.x[v[2]];
        const Vec2 low{std::min({a.x, b.x, c.x}), std::min({a.y, b.y, c.y})},
            high{std::max({a.x, b.x, c.x}), std::max({a.y, b.y, c.y})};
        const auto [nearest, farthest] = std::minmax({p.q[v[0]].z, p.q[v[1]].z, p.q[v[2]].z});
        const double touching = contact(spacing_, largest_, std::max(std::fabs(nearest), std::fabs(farthest)));
        if ((view_.camera.perspective ? nearest : 1) < least_weight_) return out;
        const bool crossed = silhouette_grid_.in(low, high, farthest + touching);
        if (!crossed && hit.clear && !hit.missed) {
            if (!overlapping_parts_.in(low, high)) out.state = view_.seen[f] ? CreaseFace::seen : CreaseFace::clear;
            return out;
        }
        if (!hit.missed) return out;
        // Each point of a side is near enough to one of its ends for the hint to cover it.
        const auto squared = [](Vec2 side) { return side.x * side.x + side.y * side.y; };
        const double longest = std::sqrt(std::max({squared(b - a), squared(c - b), squared(a - c)}));
        double samples = 0;
        if (behind && !crossed && longest <= 2 * OcclusionHint::reach) {
            samples = density_of_hidden_;
            out.state = CreaseFace::hidden;
        } else if (hits.is_turned_away(v[0], side_of(view_, f))) {
            samples = CreaseSamples::turned_away;
            out.state = crossed || hit.partly ? CreaseFace::turned : CreaseFace::hidden;
        } else {
            return out;
        }
        out.pixels = float(longest * samples), out.importance = float(view_.importance.mean(low, high));
        return out;
    }

    // Values at the corners are compared only for faces of one colour.
    float value_of(int64_t f) const {
        const SceneView<T>& scene = view_.scene;
        const auto sum = [](const auto* values, int n) {
            double all = 0;
            for (int i = 0; i < n; ++i) all += (i + 1) * double(values[i]);
            return float(all);
        };
        if (const Attributes& a = scene.attributes; a.face_width) return sum(a.face + a.face_width * f, a.face_width);
        const int32_t* row = scene.corners + 3 * f;
        if (row[0] != row[1] || row[1] != row[2] || is_textured(scene, f))
            return std::numeric_limits<float>::quiet_NaN();
        return sum(scene.colors + scene.radiance * int64_t(row[0]), scene.radiance);
    }

    // Sets bounds for all faces of what each edge would need: the size of coordinates and their spacing.
    void set_bounds() {
        const auto parts = view_.team.map_blocks(view_.scene.n_verts, [&](int64_t first, int64_t last) {
            double most[3] = {};
            for (int64_t v = first; v < last; ++v)
                for (int i = 0; i < 3; ++i) most[i] = std::max(most[i], std::fabs(view_.scene.verts[3 * v + i]));
            return Vec3{most[0], most[1], most[2]};
        });
        double by_axis[3] = {};
        for (const Vec3& m : parts) {
            const double of_part[3] = {m.x, m.y, m.z};
            for (int i = 0; i < 3; ++i) by_axis[i] = std::max(by_axis[i], of_part[i]);
        }
        largest_ = std::max({by_axis[0], by_axis[1], by_axis[2]});
        spacing_ = view_.scene.spacing->coarsest();
        const double margin = 2 * (view_.importance.radius() + 1);
        const double pixels = 2 * (view_.camera.width + view_.camera.height + 2 * margin);
        const auto matters = [&](double w) { return !(finder_.rounding(by_axis, w, pixels) < float_reach); };
        if (matters(least_weight_)) {
            while (least_weight_ < std::numeric_limits<double>::infinity() && matters(least_weight_))
                least_weight_ *= 2;
        } else {
            while (least_weight_ > std::numeric_limits<double>::min() && !matters(least_weight_ / 2))
                least_weight_ /= 2;
        }
    }

    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    const SilhouetteGrid& silhouette_grid_;
    const OverlappingParts& overlapping_parts_;
    Array<CreaseFace> faces_;
    double largest_ = 0, spacing_ = 0;
    double least_weight_ = 1;  // a power of two: depth weight from which the rounding of positions does not matter
    const double density_of_hidden_;  // relative density, on creases that lie behind all hits around them
};

}  // namespace edgegrad
