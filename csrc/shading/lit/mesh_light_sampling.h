// Samples points of an emissive mesh for a surface point y: by the directions towards them, converted by the solid
// angle per area, or by what a lobe's direction hits.
//
// A direction l may pass through several faces. Each point q of them then has the pdf p(l) |dl/dq|, because on one face
// l determines q and q determines l. All of them are candidates, and the pdf of one is independent of the others.
// Points that certainly lie behind another face of the light are left out, as no light arrives from them.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "shading/lit/area.h"
#include "shading/lit/bsdf_sampling.h"
#include "shading/lit/emissive_face_tree.h"

namespace edgegrad {

// Holds a point of a light that may be kept.
struct Candidate {
    LightPoint point;
    Vec3 l;                  // unit direction towards the point
    double brightness = 0;   // approximate, but zero nowhere
    double solid_angle = 1;  // |dl/dq| of the coordinates that its pdf counts
};

// These decide whether the lobe draws directions, too. They would only miss a light that lies within a part of the
// lobe. Far from its centre, the lobe scatters evenly to all of the light.
constexpr double least_emitter = 0.25;  // solid angle over the lobe's
constexpr double least_round = 1;       // The limit is higher for round lights, which sample themselves better.
constexpr double farthest_lobe = 4;     // distance of both, in half angles of the lobe
constexpr double smallest_emitter =
    0.1;  // Below this solid angle over the lobe's, points of a flat light are equivalent.
// It bounds the largest pdf of points over the mean, for lights of about even emission.
constexpr double most_uneven = 4;

// Returns whether a light with such pdfs by area is sampled by directions to its bounding sphere. Half of the points
// sampled by area would face away. Directions that fill a cone evenly contribute about equally.
inline bool is_round(const EmissiveFaceTree& tree, const double* pdf, int64_t n) {
    return tree.fills_ball() && *std::max_element(pdf, pdf + n) * tree.area() <= most_uneven;
}

class EmissiveMeshSampler {
   public:
    // `own` is the surface's face, counted in the scene.
    EmissiveMeshSampler(const LitScene& lit, const Light& light, const DrawnLobe& lobe, Vec3 y, int64_t own)
        : lit_(lit), light_(light), from_(lit.emitter(light)), tree_(*light.tree), y_(y), own_(own - from_.first) {
        const double size = std::max({std::fabs(y.x), std::fabs(y.y), std::fabs(y.z), tree_.size()});
        contact_ = 32 * light.eps * size;
        const Vec3 to = tree_.center() - y;
        distance_ = length(to);
        if (distance_ > tree_.radius()) {
            sine_ = tree_.radius() / distance_, cosine_ = std::sqrt(1 - sine_ * sine_);
            middle_ = (1 / distance_) * to;
        }
        by_lobe_ = is_drawn_by(lobe), by_ball_ = is_round() && !by_lobe_;
        interchangeable_ = by_ball_ || (tree_.is_flat() && solid_angle() < smallest_emitter * lobe.solid_angle());
        if (by_ball_) around_ = axes_around(middle_);
    }

    // Returns whether the lobe draws directions, too.
    bool by_lobe() const { return by_lobe_; }
    // Returns whether the light's own points contribute about equally, so that any one will do.
    bool interchangeable() const { return interchangeable_; }

    // Calls found(candidate) for what the light draws from numbers in [0, 1).
    template <class Found>
    void draw_by_light(Vec2 u, Found found) const {
        if (!by_ball_) return found(of(draw(light_, u)));
        // This is uniform in the cone around the bounding sphere.
        const double z = u.y * one_minus_cosine(), across = std::sqrt(z * (2 - z)), phi = 2 * M_PI * u.x;
        const Vec3 l{across * std::cos(phi), across * std::sin(phi), 1 - z};
        each_towards(transposed_times(around_, l), found);
    }

    // Returns a point drawn by any technique as a candidate, with the pdf of the light's own technique.
    Candidate of(const LightPoint& p) const {
        const FacePoint<double> at = on_emitter<double>(from_, p);
        Vec3 corner[3], away = y_;
        for (int i = 0; i < 3; ++i) {
            corner[i] = lit_.tables[from_.verts].vector_at<double>(at.vertex[i]);
            away -= at.b[i] * corner[i];
        }
        const Vec3 normal = cross(corner[1] - corner[0], corner[2] - corner[0]);
        const double squared = dot(away, away), facing = dot(normal, away), area = length(normal);
        Candidate c{p, {}, 0, 0};
        if (!(squared > 0 && area > 0) || p.index == own_) return c;
        c.l = -unit(away);
        if (facing < 0 && (!from_.two_sided || hides_back(p, away))) return c;
        c.solid_angle = std::fabs(facing) / (area * squared * std::sqrt(squared));
        if (by_ball_) c.point.pdf = c.solid_angle / solid_angle();
        double radiance[most_lit_channels];
        value(lit_.tables, from_.emission, at, lit_.channels, radiance);
        for (int k = 0; k < lit_.channels; ++k) c.brightness += std::fabs(radiance[k]) / lit_.channels;
        c.brightness += light_.brightness[0];
        return c;
    }

    // Calls found(candidate) for the points in the direction l.
    template <class Found>
    void each_towards(Vec3 l, Found found) const {
        hits_.clear();
        double nearest = INFINITY;
        tree_.each_hit(y_, l, contact_, INFINITY, [&](const EmissiveFaceTree::Hit& c) {
            if (c.face != own_) hits_.push_back(c), nearest = std::min(nearest, c.t);
            return light_.hides ? nearest + contact_ : INFINITY;
        });
        // Sorting by distance, then by face makes the order independent of the tree's.
        std::sort(hits_.begin(), hits_.end(),
                  [](const auto& a, const auto& b) { return a.t != b.t ? a.t < b.t : a.face < b.face; });
        for (const EmissiveFaceTree::Hit& c : hits_) {
            if (light_.hides && c.t > nearest + contact_) break;
            Candidate found_there = of({c.face, c.u, c.v, light_.pdf[c.face]});
            if (found_there.solid_angle > 0) found(found_there);
        }
    }

   private:
    bool is_round() const { return light_.is_round && sine_ < 1; }
    bool is_drawn_by(const DrawnLobe& lobe) const {
        if (!lobe.exists()) return false;
        const double wide = lobe.solid_angle();
        if (solid_angle() < (is_round() ? least_round : least_emitter) * wide) return false;
        const Vec3 mirrored = lobe.mirrored();
        if (sine_ >= 1) return true;
        const double half = std::acos(1 - wide / (2 * M_PI));
        return std::acos(std::clamp(dot(mirrored, middle_), -1.0, 1.0)) < std::asin(sine_) + farthest_lobe * half;
    }

    double one_minus_cosine() const { return sine_ * sine_ / (1 + cosine_); }
    double solid_angle() const { return sine_ < 1 ? 2 * M_PI * one_minus_cosine() : 4 * M_PI; }

    // Returns whether the light occludes a point that is seen from behind.
    bool hides_back(const LightPoint& p, Vec3 away) const {
        if (!light_.hides || tree_.is_flat()) return false;
        if (tree_.is_convex() && sine_ < 1) return true;
        const double r = length(away);
        bool hidden = false;
        tree_.each_hit(y_, (-1 / r) * away, contact_, r - contact_, [&](const EmissiveFaceTree::Hit& c) {
            hidden |= c.face != p.index && c.face != own_;
            return hidden ? 0 : r - contact_;
        });
        return hidden;
    }

    const LitScene& lit_;
    const Light& light_;
    const EmissiveFaces from_;
    const EmissiveFaceTree& tree_;
    Vec3 y_, middle_;
    int64_t own_;
    double contact_, distance_, sine_ = 1, cosine_ = 0;  // Half the bounding cone's angle has this sine and cosine.
    bool by_lobe_ = false, by_ball_ = false, interchangeable_ = false;
    Mat3 around_;  // These axes surround the direction to the centre.
    mutable std::vector<EmissiveFaceTree::Hit> hits_;
};

}  // namespace edgegrad
