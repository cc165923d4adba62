// This file predicts whether a crease is visible, before any sample. The prediction selects the control
// (crease_control.h) and the number of samples. Samples correct its errors, so the estimate is unbiased.
//
// Both sides of a crease are its own faces. Its visibility therefore changes only where a silhouette or border passes
// before it, or another part of the surface intersects it. Otherwise all of it is visible or none, and one point
// decides. That point is a hit on one of its faces, if nothing divides that face, or a few rays.
#pragma once

#include <cmath>
#include <cstdint>
#include <iterator>
#include <optional>

#include "boundary/curve.h"
#include "estimator/view.h"
#include "primary/coincidence.h"
#include "primary/overlapping_parts.h"
#include "primary/silhouette_grid.h"

namespace edgegrad {

// PredictedVisibility is the predicted visibility of a crease, and the fraction of its samples drawn to verify it.
struct PredictedVisibility {
    bool visible;
    double samples;
};

// CreaseSamples holds such fractions. `hidden` creases lie behind the hits and nothing divides them; a silhouette meets
// `hidden_in_part` ones. `turned_away` creases are on the back of a closed mesh. `visible` ones have nothing that
// divides them, and at least 16 rays per pixel.
struct CreaseSamples {
    static constexpr OcclusionHint::HiddenFactor hidden{.rays = 0.5, .share = 1.0 / 64, .least = 1.0 / 256},
        hidden_in_part{.rays = 2, .share = 1.0 / 128, .least = 1.0 / 256};
    static constexpr double turned_away = 1.0 / 16 * ImageHits::turned_away, visible = 1.0 / 512;
};

template <class T>
class CreaseVisibility {
   public:
    using Relation = SilhouetteGrid::Relation;

    CreaseVisibility(const BackwardView<T>& view, const SilhouetteGrid& silhouette_grid,
                     const OverlappingParts& overlapping_parts)
        : view_(view), silhouette_grid_(silhouette_grid), overlapping_parts_(overlapping_parts), rays_(view.frame) {}

    Relation relation(const Curve& c) const { return silhouette_grid_.relation(c, touching(c)); }

    // Predicts a crease that lies behind the hits in `pixels` pixels (occlusion.h). If all of it is visible or none,
    // rays cannot have missed a part in a gap.
    PredictedVisibility hidden(Relation relation, int64_t pixels) const {
        const bool whole = relation == Relation::apart;
        return {false, view_.occlusion.factor(whole ? CreaseSamples::hidden : CreaseSamples::hidden_in_part, pixels,
                                              view_.image.spp)};
    }

    // Predicts any other crease; returns nothing where rays must decide.
    std::optional<PredictedVisibility> without_rays(const Curve& c, Relation relation) const {
        const double missed = where_missed(c);
        if (relation == Relation::across) return PredictedVisibility{hits(c.minus).whole && hits(c.plus).whole, missed};
        // This crease is on the back of a closed mesh.
        if (missed < ImageHits::missed)
            return PredictedVisibility{false, relation == Relation::apart ? missed / 16 : missed};
        // Rays may slip past an own face seen edge-on, whose other sides are silhouettes then.
        if (is_thin(c, c.minus) || is_thin(c, c.plus)) return PredictedVisibility{false, missed};
        if (fewest(c, relation) != few || !(view_.seen[c.minus.face] || view_.seen[c.plus.face])) return std::nullopt;
        return PredictedVisibility{true, by_evidence(few)};
    }

    // Adds rays to some points of a crease to the batch. Returns its index there.
    int ask(const Curve& c, Relation relation) {
        const int n = points(c);
        tested_[size_] = {c, n, by_evidence(std::max(fewest(c, relation), near_silhouettes)), where_missed(c)};
        for (int i = 0; i < n; ++i) {
            const Vec2 at = normalised(view_.camera, c.position(ray_positions[i]));
            rays_.n_x[rays_.count] = at.x, rays_.n_y[rays_.count++] = at.y;
        }
        return size_++;
    }
    bool full() const { return size_ == most || rays_.count > RayBatch::size - most_points; }

    // Casts the rays. Calls body(k, curve, expected) with the answers, k = 0, 1, … in the order of ask().
    template <class Body>
    void answer(Body body) {
        rays_.prepare();
        view_.frame.cast(rays_);
        for (int k = 0, ray = 0; k < size_; ++k) {
            const auto& [c, points, fewest, missed] = tested_[k];
            int visible = 0, hidden = 0;
            for (int i = 0; i < points; ++i) {
                const RayAnswer a = at(c, ray_positions[i], ray++);
                visible += a == RayAnswer::visible, hidden += a == RayAnswer::hidden;
            }
            // Next to a hit, a crease that rays find hidden may be visible between them, as at a limb.
            const bool agreed = visible == points || (hidden == points && missed < 1);
            body(k, c, PredictedVisibility{visible > hidden, agreed ? std::min(fewest, missed) : missed});
        }
        rays_.count = size_ = 0;
    }

    static constexpr int few_points = 2, most = RayBatch::size / few_points;  // number of creases in a batch

   private:
    // Rays go to the ends of a crease. One longer than some pixels has more samples itself, and gets two points more.
    static constexpr double ray_positions[] = {0.05, 0.95, 0.35, 0.65};
    static constexpr int most_points = int(std::size(ray_positions));
    static int points(const Curve& c) { return c.length < 4 ? few_points : most_points; }

    // These least fractions of samples hold where nothing may divide a crease, or something may but rays miss it. Near
    // missed faces something may intersect, or be alpha-tested.
    static constexpr double few = CreaseSamples::visible, near_silhouettes = 1.0 / 128, near_other_parts = 1.0 / 32;
    static constexpr double near_missed = 1.0 / 8;

    // Fewer than 16 rays per pixel miss more of the places where parts meet and faces are divided.
    double by_evidence(double least) const { return OcclusionHint::factor(least, view_.image.spp); }

    double fewest(const Curve& c, Relation relation) const {
        if (view_.alpha_masks) return near_missed;
        if (relation != Relation::apart) return near_other_parts;
        Vec2 low{INFINITY, INFINITY}, high{-INFINITY, -INFINITY};  // image box of both faces
        double farthest = -INFINITY;
        for (const HalfEdge* h : {&c.minus, &c.plus})
            for (int i = 0; i < 3; ++i) {
                const int32_t v = vertex(view_.scene, *h, i);
                if (view_.vertices.outcode[v]) return near_other_parts;  // The extent of the face is unknown.
                const Vec2 x = view_.vertices.x[v];
                low = {std::min(low.x, x.x), std::min(low.y, x.y)};
                high = {std::max(high.x, x.x), std::max(high.y, x.y)};
                farthest = std::max(farthest, view_.vertices.q[v].z);
            }
        if (!hits(c.minus).clear || !hits(c.plus).clear) return near_missed;
        return overlapping_parts_.in(low, high)           ? near_other_parts
               : silhouette_grid_.in(low, high, farthest) ? near_silhouettes
                                                          : few;
    }

    // Returns whether an own face is no wider in the image than the error of rays. Their positions are rounded to
    // floats of the image's size, and again by the rotation and the cast.
    bool is_thin(const Curve& c, const HalfEdge& h) const {
        const int32_t opposite = vertex(view_.scene, h, (h.corner + 2) % 3);
        if (view_.vertices.outcode[opposite]) return false;
        const double error =
            4 * std::numeric_limits<float>::epsilon() * std::max(view_.camera.width, view_.camera.height);
        return std::fabs(wedge(c.tangent(), view_.vertices.x[opposite] - c.x0)) < error * c.length;
    }

    // RayAnswer is what a ray says of the point s of a crease. It is `unknown` where the hit is nearer by less than a
    // part of a pixel. On faces seen nearly edge-on it may be a neighbour that the ray should have missed. Contact with
    // the crease is decided in double precision.
    enum class RayAnswer { visible, hidden, unknown };
    RayAnswer at(const Curve& c, double s, int ray) const {
        const int32_t hit = rays_.face[ray];
        if (hit < 0 || hit == c.minus.face || hit == c.plus.face) return RayAnswer::visible;
        const double t = c.parameter(s), depth = (1 - t) * c.a.z + t * c.b.z;
        const double pixel = view_.camera.pixel_at_depth(depth);
        const double behind = depth_of(view_, hit, rays_.n(ray)) - depth;
        return behind > touching(c) ? RayAnswer::visible : behind < -pixel / 4 ? RayAnswer::hidden : RayAnswer::unknown;
    }

    // Returns the world units by which a touching surface may lie behind a crease.
    double touching(const Curve& c) const {
        return contact(view_.scene.spacing->of(vertex(view_.scene, c.minus, c.minus.first())),
                       largest_coordinate(view_.scene, c.minus), std::max(std::fabs(c.a.z), std::fabs(c.b.z)));
    }

    ImageHits::FaceHits hits(const HalfEdge& h) const {
        return view_.hits->of(view_.scene.faces + 3 * int64_t(h.face));
    }

    // Returns less than 1 where rays hit neither the crease nor its neighbours.
    double where_missed(const Curve& c) const {
        for (const int corner : {c.minus.first(), c.minus.second()})
            if (view_.hits->at(vertex(view_.scene, c.minus, corner))) return 1;
        return view_.hits->where_missed(view_.scene.faces[3 * int64_t(c.minus.face)], side_of(view_, c.minus.face));
    }

    struct TestedCrease {
        Curve curve;
        int points;
        double fewest, missed;
    };

    const BackwardView<T>& view_;
    const SilhouetteGrid& silhouette_grid_;
    const OverlappingParts& overlapping_parts_;
    CameraRays rays_;
    TestedCrease tested_[most];
    int size_ = 0;
};

}  // namespace edgegrad
