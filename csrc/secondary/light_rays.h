// This file traces light past the edges and alpha edges that cast shadows, to the faces behind them.
#pragma once

#include <algorithm>
#include <cmath>
#include <functional>
#include <vector>

#include "estimator/view.h"
#include "rays/alpha_mask.h"
#include "rays/plane_hit.h"
#include "scene/contact.h"
#include "scene/light_parts.h"
#include "secondary/light_wedge.h"
#include "secondary/shadow_edges.h"
#include "secondary/shadow_source.h"

namespace edgegrad {

// LightRays traces rays from points of a light past edges and alpha edges, in batches.
template <class T>
class LightRays {
   public:
    LightRays(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light,
              const std::vector<AlphaEdge>& alpha_edges)
        : view_(view), casters_(casters), light_(light), alpha_edges_(alpha_edges) {}

    // Adds the ray from a point of the light past the place t of an edge or an alpha edge. `segment` identifies it.
    void add(const ShadowPiece& piece, LightWedge::Point from, int64_t segment, double t, double weight) {
        PendingRay& w = pending_[count_];
        w.point = {.caster = {},
                   .part = piece.part,
                   .uv = from.uv,
                   .light = light_.at(piece.part, from.uv),
                   .side = from.side,
                   .segment = segment};
        w.weight = weight;
        w.edge = piece.edge;
        if (!(piece.is_alpha_edge() ? set_alpha_edge(alpha_edges_[piece.alpha_edge()], t, w)
                                    : set_edge(piece.edge, t, w)))
            return;
        const Vec3 light = w.point.light;
        if (light_.infinite) {
            // The ray starts outside of the scene.
            const RayFrame& frame = view_.geometry.caster().frame();
            w.before = (4 * frame.radius * frame.unit + length(w.p - frame.centre)) / length(light);
            w.ray = {w.p + w.before * light, -light};
        } else {
            w.before = 1;
            w.ray = {light, w.p - light};
        }
        auto& without = without_[count_];
        const auto adjacent = adjacent_faces(w);
        without.assign(adjacent.begin(), adjacent.end());
        if (const int32_t own = light_.face[piece.part]; own >= 0) without.push_back(own);
        std::sort(without.begin(), without.end());
        ++count_;
    }

    bool is_full() const { return count_ == RayBatch::size; }

    // Calls body(ShadowPoint, weight) for each face that light reaches past the edges. These are the first face that
    // casts a shadow, and the faces before it that transmit light.
    void cast(const std::function<void(const ShadowPoint&, double)>& body) {
        while (count_ > 0) {
            int32_t face[RayBatch::size];
            PlaneHit met[RayBatch::size];
            cast_each(
                view_.geometry.caster(), count_, face, without_, [&](int i) { return pending_[i].ray; },
                [&](int i, int32_t f) { return accept(pending_[i], f, met[i]); });
            int continued = 0;
            for (int i = 0; i < count_; ++i) {
                if (face[i] < 0) continue;
                PendingRay& w = pending_[i];
                w.point.face = face[i], w.point.on = inside({met[i].u, met[i].v});
                w.point.along = light_.infinite ? met[i].t - w.before : met[i].t;
                // A face before the edge, or touching it, bears no shadow boundary. The shadow begins there, along a
                // curve that the camera sees as an edge.
                if (met[i].t > w.before + touching(w, face[i])) body(w.point, w.weight);
                if (casters_.alpha_masks.on(face[i]) && !shows(casters_, face[i], w.point.on))
                    continue_ray(continued++, i);
            }
            count_ = continued;
        }
    }

   private:
    struct PendingRay {
        ShadowPoint point;
        double weight;
        int64_t edge;
        int32_t face;  // face of an alpha edge
        Vec3 p;        // point of the edge, world coordinates
        Ray ray;
        double before;  // position of the edge on the ray, in lengths of its direction
    };

    // Continues the i-th ray, as the k-th, behind the face that it met.
    void continue_ray(int k, int i) {
        std::vector<int32_t>& without = without_[i];
        without.insert(std::upper_bound(without.begin(), without.end(), pending_[i].point.face),
                       pending_[i].point.face);
        if (k == i) return;
        pending_[k] = pending_[i];
        without_[k].swap(without);
    }

    bool set_edge(int64_t edge, double t, PendingRay& w) const {
        if (!casts(edge, t, w.point)) return false;
        w.point.caster = occluder_of(view_.scene, view_.geometry.topology().half_edges(edge)[0], t);
        w.p = w.point.caster.sum(w.point.caster.weight, vertices());
        return true;
    }

    bool set_alpha_edge(const AlphaEdge& alpha_edge, double t, PendingRay& w) const {
        AlphaEdgePoint place{};
        if (!AlphaEdgeFinder<T>(casters_).place(alpha_edge, t, place)) return false;
        w.point.caster = occluder_of(casters_, alpha_edge, place);
        // It is dark where f > 0.
        const Vec3 p = w.point.caster.sum(w.point.caster.weight, vertices());
        const double turned = w.point.caster.turned(light_.infinite ? -w.point.light : p - w.point.light, vertices());
        if (!(std::fabs(turned) > 0)) return false;
        w.point.side = turned > 0 ? 1 : -1;
        w.p = next_to_alpha_edge(casters_, alpha_edge, place);
        w.face = alpha_edge.face;
        return true;
    }

    auto vertices() const {
        return [&](int32_t i) { return vec(view_.scene.verts + 3 * int64_t(i)); };
    }
    // Returns the faces of the edge, or the face of the alpha edge.
    std::span<const int32_t> adjacent_faces(const PendingRay& w) const {
        return w.edge < 0 ? std::span<const int32_t>(&w.face, 1) : view_.geometry.topology().faces(w.edge);
    }

    // Returns whether a face next to the edge casts a shadow from that place. Light passes on both sides if no face is
    // opaque there. If some faces are masked, the opaque ones must lie on one side, which sets `point.side`.
    bool casts(int64_t edge, double t, ShadowPoint& point) const {
        const auto halves = view_.geometry.topology().half_edges(edge);
        const auto there = [&](const HalfEdge& h) { return is_there(casters_, h, t); };
        if (!alpha_masks_jump(casters_, view_.geometry.topology(), edge))
            return std::any_of(halves.begin(), halves.end(), there);
        bool on_side[2] = {};
        for (const HalfEdge& h : halves) {
            if (!there(h)) continue;
            const Vec3 v = corner(casters_, h.face, 0), to = light_.infinite ? point.light : point.light - v;
            const double height = dot(cross(corner(casters_, h.face, 1) - v, corner(casters_, h.face, 2) - v), to);
            if (height != 0) on_side[(height < 0) != h.backwards] = true;
        }
        point.side = on_side[1] ? -1 : 1;
        return on_side[0] != on_side[1];
    }

    bool accept(const PendingRay& w, int32_t face, PlaneHit& m) const {
        m = intersect_plane(view_.scene, face, w.ray);
        if (!m.exists() || m.t <= 0 || m.margin() < -PlaneHit::rounding) return false;
        // A ray through the border of a face hits or misses it as if the light had moved a little (FacesBeforeLight).
        // An example is a light in the side of a box.
        if (m.margin() <= PlaneHit::rounding) {
            constexpr double perturbation = 1e-7;
            const Vec3 moved = (perturbation * length(w.ray.direction)) * FacesBeforeLight<T>::aside;
            const Vec3 origin = w.ray.origin + (light_.infinite ? w.before : 1) * moved;
            const PlaneHit adjacent = intersect_plane(view_.scene, face, {origin, w.p - origin});
            if (!adjacent.exists() || adjacent.margin() < 0) return false;
        }
        // This is the light itself: its point lies on this face or on a neighbour.
        if (light_.face[w.point.part] >= 0 && m.t <= touching(w, face)) return false;
        return shows(view_.scene, face, inside({m.u, m.v}));
    }

    // Returns how far along its ray an edge may lie from a face that it touches, up to the rounding of the input.
    double touching(const PendingRay& w, int32_t face) const {
        const SceneView<T>& scene = view_.scene;
        for (const int32_t adjacent : adjacent_faces(w))
            if (share_vertex(scene, face, adjacent)) return PlaneHit::rounding * w.before;
        const int32_t* v = scene.faces + 3 * int64_t(face);
        double size = 0;
        for (int i = 0; i < 3; ++i)
            for (int axis = 0; axis < 3; ++axis)
                size = std::max(size, std::fabs(scene.verts[3 * int64_t(v[i]) + axis]));
        const Vec3 q = corner(scene, face, 0);
        const Vec3 m = cross(corner(scene, face, 1) - q, corner(scene, face, 2) - q);
        const double spacing = std::max(scene.spacing->of(v[0]), scene.spacing->of(w.point.caster.vertex[0]));
        // The rounding is measured across the face, so it is longer along a ray that grazes it.
        return contact(spacing, size, size) * length(m) / std::fabs(dot(m, w.ray.direction));
    }

    const BackwardView<T>& view_;
    const SceneView<T>& casters_;
    const LightParts& light_;
    const std::vector<AlphaEdge>& alpha_edges_;
    PendingRay pending_[RayBatch::size];
    std::vector<int32_t> without_[RayBatch::size];
    int count_ = 0;
};

}  // namespace edgegrad
