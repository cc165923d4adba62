// Whether a crease is visible, as far as that is known before any sample. It decides whether the control
// (crease_control.h) is added, and how few samples will do; what it gets wrong they put right, so nothing is biased.
//
// Both sides of a crease are faces of its own, so its visibility changes only where a silhouette or border passes
// before it, or where another part of the surface passes through it. Apart from these all of it is visible or none, and
// one point tells which: a face of it that the image hit, if nothing divides that face, or a few rays.
#pragma once

#include <cmath>
#include <cstdint>
#include <iterator>
#include <optional>

#include "boundary/curve.h"
#include "estimator/view.h"
#include "primary/coincidence.h"
#include "primary/crossings.h"
#include "primary/meeting_parts.h"

namespace edgegrad {

// What is expected of a crease, and the fraction of its samples that is drawn to make sure.
struct Expected {
    bool visible;
    double samples;
};

// Such fractions: of creases behind what the image hit that nothing divides, or that a silhouette meets; on the side of
// a closed mesh that is turned away; and of visible ones that nothing divides, with at least 16 rays a pixel.
struct CreaseSamples {
    static constexpr OcclusionHint::Few hidden{.rays = 0.5, .share = 1.0 / 64, .least = 1.0 / 256},
        hidden_in_part{.rays = 2, .share = 1.0 / 128, .least = 1.0 / 256};
    static constexpr double turned_away = 1.0 / 16 * ImageHits::turned_away, visible = 1.0 / 512;
};

template <class T>
class CreaseVisibility {
   public:
    using Relation = Crossings::Relation;

    CreaseVisibility(const BackwardView<T>& view, const Crossings& crossings, const MeetingParts& meeting)
        : view_(view), crossings_(crossings), meeting_(meeting), rays_(view.frame) {}

    Relation relation(const Curve& c) const { return crossings_.relation(c, touching(c)); }

    // Of a crease behind what the image hit in so many pixels (occlusion.h). If all of it is visible or none, a part
    // that shows through a gap cannot be what rays missed.
    Expected hidden(Relation relation, int64_t pixels) const {
        const bool whole = relation == Relation::apart;
        return {false, view_.occlusion.factor(whole ? CreaseSamples::hidden : CreaseSamples::hidden_in_part, pixels,
                                              view_.image.spp)};
    }

    // Of any other; nothing where rays must say.
    std::optional<Expected> without_rays(const Curve& c, Relation relation) const {
        const double missed = where_missed(c);
        if (relation == Relation::across) return Expected{hits(c.minus).whole && hits(c.plus).whole, missed};
        // On the side of a closed mesh that is turned away.
        if (missed < ImageHits::missed) return Expected{false, relation == Relation::apart ? missed / 16 : missed};
        // Rays may slip past an own face that is seen edge-on, whose other sides are silhouettes then.
        if (is_thin(c, c.minus) || is_thin(c, c.plus)) return Expected{false, missed};
        if (fewest(c, relation) != few || !(view_.seen[c.minus.face] || view_.seen[c.plus.face])) return std::nullopt;
        return Expected{true, by_evidence(few)};
    }

    // Adds rays to some points of a crease to the batch; returns its place there.
    int ask(const Curve& c, Relation relation) {
        const int n = points(c);
        asked_[size_] = {c, n, by_evidence(std::max(fewest(c, relation), near_silhouettes)), where_missed(c)};
        for (int i = 0; i < n; ++i) {
            const Vec2 at = normalised(view_.camera, c.position(asked_at[i]));
            rays_.n_x[rays_.count] = at.x, rays_.n_y[rays_.count++] = at.y;
        }
        return size_++;
    }
    bool full() const { return size_ == most || rays_.count > RayBatch::size - most_points; }

    // Casts them; body(k, curve, expected) gets the answers, k = 0, 1, … as they were asked.
    template <class Body>
    void answer(Body body) {
        rays_.prepare();
        view_.frame.cast(rays_);
        for (int k = 0, ray = 0; k < size_; ++k) {
            const auto& [c, points, fewest, missed] = asked_[k];
            int visible = 0, hidden = 0;
            for (int i = 0; i < points; ++i) {
                const Answer a = at(c, asked_at[i], ray++);
                visible += a == Answer::visible, hidden += a == Answer::hidden;
            }
            // Next to what the image hit, one that rays find hidden may be visible between them, as at a limb.
            const bool agreed = visible == points || (hidden == points && missed < 1);
            body(k, c, Expected{visible > hidden, agreed ? std::min(fewest, missed) : missed});
        }
        rays_.count = size_ = 0;
    }

    static constexpr int few_points = 2, most = RayBatch::size / few_points;  // creases in a batch

   private:
    // Where rays go: the ends of a crease that is no longer than some pixels, which has few samples itself; two points
    // more of others.
    static constexpr double asked_at[] = {0.05, 0.95, 0.35, 0.65};
    static constexpr int most_points = int(std::size(asked_at));
    static int points(const Curve& c) { return c.length < 4 ? few_points : most_points; }

    // Least fractions of the samples: where nothing may divide a crease; and where it may, but rays find it undivided.
    static constexpr double few = CreaseSamples::visible, near_silhouettes = 1.0 / 128, near_other_parts = 1.0 / 32,
                            near_missed = 1.0 / 8;  // faces near which others were not hit: something may pass
                                                    // through, or be alpha-tested

    // Fewer than 16 rays a pixel miss more of where parts meet, and of which faces are divided.
    double by_evidence(double least) const { return OcclusionHint::factor(least, view_.image.spp); }

    double fewest(const Curve& c, Relation relation) const {
        if (view_.alpha_masks) return near_missed;
        if (relation != Relation::apart) return near_other_parts;
        Vec2 low{INFINITY, INFINITY}, high{-INFINITY, -INFINITY};  // of both faces
        double farthest = -INFINITY;
        for (const HalfEdge* h : {&c.minus, &c.plus})
            for (int i = 0; i < 3; ++i) {
                const int32_t v = vertex(view_.scene, *h, i);
                if (view_.vertices.outcode[v]) return near_other_parts;  // it is not known where all of the face is
                const Vec2 x = view_.vertices.x[v];
                low = {std::min(low.x, x.x), std::min(low.y, x.y)};
                high = {std::max(high.x, x.x), std::max(high.y, x.y)};
                farthest = std::max(farthest, view_.vertices.q[v].z);
            }
        if (!hits(c.minus).clear || !hits(c.plus).clear) return near_missed;
        return meeting_.in(low, high) ? near_other_parts : crossings_.in(low, high, farthest) ? near_silhouettes : few;
    }

    // Whether an own face is no wider in the image than rays err: their places are rounded to floats of the image's
    // size, and again as they are turned and cast.
    bool is_thin(const Curve& c, const HalfEdge& h) const {
        const int32_t opposite = vertex(view_.scene, h, (h.corner + 2) % 3);
        if (view_.vertices.outcode[opposite]) return false;
        const double error =
            4 * std::numeric_limits<float>::epsilon() * std::max(view_.camera.width, view_.camera.height);
        return std::fabs(wedge(c.tangent(), view_.vertices.x[opposite] - c.x0)) < error * c.length;
    }

    // What a ray says of the point s of a crease. Of what is nearer by less than a part of a pixel it does not say:
    // where faces are seen nearly edge-on, it may be a neighbour that the ray should have missed, and what touches the
    // crease is decided in double.
    enum class Answer { visible, hidden, unknown };
    Answer at(const Curve& c, double s, int ray) const {
        const int32_t hit = rays_.face[ray];
        if (hit < 0 || hit == c.minus.face || hit == c.plus.face) return Answer::visible;
        const double t = c.parameter(s), depth = (1 - t) * c.a.z + t * c.b.z;
        const double pixel = view_.camera.pixel_at_depth(depth);
        const double behind = depth_of(view_, hit, rays_.n(ray)) - depth;
        return behind > touching(c) ? Answer::visible : behind < -pixel / 4 ? Answer::hidden : Answer::unknown;
    }

    // World units by which what touches a crease may lie behind it.
    double touching(const Curve& c) const {
        return contact(view_.scene.spacing->of(vertex(view_.scene, c.minus, c.minus.first())),
                       largest_coordinate(view_.scene, c.minus), std::max(std::fabs(c.a.z), std::fabs(c.b.z)));
    }

    ImageHits::Face hits(const HalfEdge& h) const { return view_.hits->of(view_.scene.faces + 3 * int64_t(h.face)); }

    // Less than 1 where the image hit neither the crease nor its neighbours.
    double where_missed(const Curve& c) const {
        for (const int corner : {c.minus.first(), c.minus.second()})
            if (view_.hits->at(vertex(view_.scene, c.minus, corner))) return 1;
        return view_.hits->where_missed(view_.scene.faces[3 * int64_t(c.minus.face)], side_of(view_, c.minus.face));
    }

    struct Asked {
        Curve curve;
        int points;
        double fewest, missed;
    };

    const BackwardView<T>& view_;
    const Crossings& crossings_;
    const MeetingParts& meeting_;
    CameraRays rays_;
    Asked asked_[most];
    int size_ = 0;
};

}  // namespace edgegrad
