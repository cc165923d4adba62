// Points of a mesh that emits as a point y of a surface meets them: with the direction towards them, by how much solid
// angle grows with area there, and what lies in a direction that a lobe has drawn.
//
// A direction l may pass through several faces. Each point q of them is then drawn with the density p(l) |dl/dq|, for
// on one face l says q and q says l; so all of them are candidates, and the density of a point asks nothing about
// others. But what surely lies behind another face of the lamp is left out, since no light comes from there.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "shading/lit/area.h"
#include "shading/lit/lamp_tree.h"
#include "shading/lit/lobe_draw.h"

namespace edgegrad {

// A point of a light that may be kept.
struct Candidate {
    LightPoint point;
    Vec3 l;                  // unit, towards it
    double brightness = 0;   // about, but nowhere zero
    double solid_angle = 1;  // |dl/dq| of the coordinates that its density counts
};

// Whether directions are drawn by the lobe as well: where all of the lamp lies within a part of it they would only
// miss, and far off the lobe scatters alike to all of the lamp.
constexpr double least_lamp = 0.25;    // solid angle over that of the lobe
constexpr double farthest_lobe = 4;    // between them, in half angles of the lobe
constexpr double smallest_lamp = 0.1;  // solid angle over that of the lobe, below which points of a flat lamp are alike

class MeshTowards {
   public:
    // `own`: the surface's face, as the scene counts them.
    MeshTowards(const LitScene& lit, const Lamp& lamp, Vec3 y, int64_t own)
        : lit_(lit), lamp_(lamp), from_(lit.emitter(lamp)), tree_(*lamp.tree), y_(y), own_(own - from_.first) {
        const double size = std::max({std::fabs(y.x), std::fabs(y.y), std::fabs(y.z), tree_.size()});
        contact_ = 32 * lamp.eps * size;
        const Vec3 to = tree_.center() - y;
        distance_ = length(to);
        if (distance_ > tree_.radius()) {
            sine_ = tree_.radius() / distance_, cosine_ = std::sqrt(1 - sine_ * sine_);
            middle_ = (1 / distance_) * to;
        }
    }

    // Whether its points are so much alike that one is as good as another.
    bool is_small(const DrawnLobe& lobe) const {
        return tree_.is_flat() && solid_angle() < smallest_lamp * lobe.solid_angle();
    }

    bool is_drawn_by(const DrawnLobe& lobe) const {
        if (!lobe.exists()) return false;
        const double wide = lobe.solid_angle();
        if (solid_angle() < least_lamp * wide) return false;
        const Vec3 mirrored = lobe.mirrored();
        if (sine_ >= 1) return true;
        const double half = std::acos(1 - wide / (2 * M_PI));
        return std::acos(std::clamp(dot(mirrored, middle_), -1.0, 1.0)) < std::asin(sine_) + farthest_lobe * half;
    }

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
        double radiance[most_lit_channels];
        value(lit_.tables, from_.emission, at, lit_.channels, radiance);
        for (int k = 0; k < lit_.channels; ++k) c.brightness += std::fabs(radiance[k]) / lit_.channels;
        c.brightness += lamp_.brightness[0];
        return c;
    }

    // Calls found(candidate) for what lies in the direction l.
    template <class Found>
    void each_towards(Vec3 l, Found found) const {
        crossings_.clear();
        double nearest = INFINITY;
        tree_.each_crossing(y_, l, contact_, INFINITY, [&](const LampTree::Crossing& c) {
            if (c.face != own_) crossings_.push_back(c), nearest = std::min(nearest, c.t);
            return true;
        });
        // Whatever the tree's order: by distance, and of what is as far by number.
        std::sort(crossings_.begin(), crossings_.end(),
                  [](const auto& a, const auto& b) { return a.t != b.t ? a.t < b.t : a.face < b.face; });
        for (const LampTree::Crossing& c : crossings_) {
            if (lamp_.hides && c.t > nearest + contact_) break;
            Candidate found_there = of({c.face, c.u, c.v, lamp_.density[c.face]});
            if (found_there.solid_angle > 0) found(found_there);
        }
    }

   private:
    double solid_angle() const { return sine_ < 1 ? 2 * M_PI * (1 - cosine_) : 4 * M_PI; }

    // Whether the lamp hides a point that is seen from behind.
    bool hides_back(const LightPoint& p, Vec3 away) const {
        if (!lamp_.hides || tree_.is_flat()) return false;
        if (tree_.is_convex() && sine_ < 1) return true;
        const double r = length(away);
        bool hidden = false;
        tree_.each_crossing(y_, (-1 / r) * away, contact_, r - contact_, [&](const LampTree::Crossing& c) {
            hidden = c.face != p.index && c.face != own_;
            return !hidden;
        });
        return hidden;
    }

    const LitScene& lit_;
    const Lamp& lamp_;
    const EmissiveFaces from_;
    const LampTree& tree_;
    Vec3 y_, middle_;
    int64_t own_;
    double contact_, distance_, sine_ = 1, cosine_ = 0;  // of half the angle of the ball around the lamp
    mutable std::vector<LampTree::Crossing> crossings_;
};

}  // namespace edgegrad
