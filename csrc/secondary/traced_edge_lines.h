// This file traces lines past edges and alpha edges to what lies at both of their ends.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "boundary/curve.h"
#include "estimator/view.h"
#include "rays/alpha_mask.h"
#include "rays/plane_hit.h"
#include "scene/contact.h"
#include "secondary/edge_line_source.h"
#include "secondary/lune.h"
#include "secondary/occluder.h"

namespace edgegrad {

// TracedEdgeLines traces lines in batches. `casters` is the scene as light meets it.
template <class T>
class TracedEdgeLines {
   public:
    TracedEdgeLines(const BackwardView<T>& view, const SceneView<T>& casters, const std::vector<AlphaEdge>& alpha_edges)
        : view_(view), casters_(casters), alpha_edges_(alpha_edges), caster_(view.geometry.caster()) {
        // A ray starts this far before the edge, so that single precision finds faces that touch the edge.
        const RayFrame& frame = caster_.frame();
        constexpr double rounding_of_floats = 0x1p-18;
        size_ = frame.radius * frame.unit, before_ = rounding_of_floats * size_;
    }

    // Adds a line along the unit direction w, of either sign, past the place t of an edge. Alpha edges are numbered
    // after all edges. `segment` is the caller's number for it.
    void add(int64_t piece, double t, Vec3 w, int64_t segment, double weight) {
        PendingLine& o = pending_[count_];
        const int64_t edges = view_.geometry.topology().n_edges();
        o.line = EdgeLine();
        o.edge = piece < edges ? piece : -1, o.weight = weight, o.line.w = w, o.line.segment = segment;
        if (!(o.edge < 0 ? set_alpha_edge(alpha_edges_[piece - edges], t, o) : set_edge(t, o))) return;
        const Occluder& occluder = o.line.occluder;
        o.tangent = occluder.sum(occluder.tangent, vertices());
        const auto adjacent = adjacent_faces(o);
        without_[count_].assign(adjacent.begin(), adjacent.end());
        std::sort(without_[count_].begin(), without_[count_].end());
        ++count_;
    }

    bool is_full() const { return count_ == RayBatch::size; }

    // Calls body(line, weight) for both ways along each line, if there is a face at both of its ends.
    template <class Body>
    void cast(Body body) {
        for (int side = 0; side < 2; ++side) {
            find_ends(side);
            int kept = 0;
            for (int i = 0; i < count_; ++i)
                if (pending_[i].end[side].face >= 0) pending_[kept++] = pending_[i];
            count_ = kept;
        }
        for (int i = 0; i < count_; ++i)
            for (int receiver = 0; receiver < 2; ++receiver)
                if (set(pending_[i], receiver)) body(pending_[i].line, pending_[i].weight);
        count_ = 0;
    }

   private:
    // An End is what the line meets beyond the edge, against its direction or along it.
    struct End {
        int32_t face = -1;
        Barycentrics at;
        double distance;  // distance from the edge; 0: the edge lies on that face
    };
    struct PendingLine {
        EdgeLine line;
        double weight;
        int64_t edge;     // −1 for an alpha edge
        int32_t face;     // face of an alpha edge
        Vec3 p, tangent;  // world coordinates
        End end[2];

        Vec3 direction(int side) const { return side ? line.w : -line.w; }
    };

    auto vertices() const {
        return [&](int32_t i) { return vec(view_.scene.verts + 3 * int64_t(i)); };
    }
    // Returns the faces of the edge, or the face of the alpha edge.
    std::span<const int32_t> adjacent_faces(const PendingLine& o) const {
        return o.edge < 0 ? std::span<const int32_t>(&o.face, 1) : view_.geometry.topology().faces(o.edge);
    }

    // Lines are drawn as if all passed where faces may be masked. Lines past the opaque faces are kept.
    bool set_edge(double t, PendingLine& o) {
        const auto halves = view_.geometry.topology().half_edges(o.edge);
        const HalfEdge& own = halves[0];
        o.line.occluder = occluder_of(view_.scene, own, t);
        o.p = o.line.occluder.sum(o.line.occluder.weight, vertices());
        if (!casters_.alpha_masks.face) return true;
        opposite_.clear();
        for (const HalfEdge& h : halves)
            if (is_there(casters_, h, t)) opposite_.push_back(corner(view_.scene, h.face, (h.corner + 2) % 3));
        if (opposite_.size() == halves.size() && !alpha_masks_jump(casters_, view_.geometry.topology(), o.edge))
            return true;
        const Lune lune(corner(view_.scene, own.face, own.first()), corner(view_.scene, own.face, own.second()),
                        opposite_);
        const Lune::Coordinates line = lune.locate(o.line.w);
        o.line.w = line.w;
        return line.is_there();
    }
    bool set_alpha_edge(const AlphaEdge& alpha_edge, double t, PendingLine& o) const {
        AlphaEdgePoint place{};
        if (!AlphaEdgeFinder<T>(casters_).place(alpha_edge, t, place)) return false;
        o.line.occluder = occluder_of(casters_, alpha_edge, place);
        const double turned = o.line.occluder.turned(o.line.w, vertices());
        if (!(std::fabs(turned) > 0)) return false;
        if (turned > 0) o.line.w = -o.line.w;  // The face is opaque where κ D F > 0.
        o.p = next_to_alpha_edge(casters_, alpha_edge, place), o.face = alpha_edge.face;
        return true;
    }

    void find_ends(int side) {
        int32_t face[RayBatch::size];
        cast_each(
            caster_, count_, face, without_,
            [&](int i) {
                const Vec3 d = pending_[i].direction(side);
                return Ray{pending_[i].p - before_ * d, d};
            },
            [&](int i, int32_t f) { return accept(pending_[i], side, f, pending_[i].end[side]); });
        for (int i = 0; i < count_; ++i) pending_[i].end[side].face = face[i];
    }

    // Returns whether the line ends on a face.
    bool accept(const PendingLine& o, int side, int32_t face, End& end) const {
        const SceneView<T>& scene = view_.scene;
        const Vec3 d = o.direction(side), q = corner(scene, face, 0);
        const Vec3 m = cross(corner(scene, face, 1) - q, corner(scene, face, 2) - q);
        const PlaneHit met = intersect_plane(scene, face, {o.p, d});
        if (!met.exists()) return false;
        const bool outside = met.margin() < -PlaneHit::rounding;
        end.at = inside({met.u, met.v}), end.distance = met.t;
        if (!shows(casters_, face, end.at)) return false;
        // Near a face's border single and double precision may differ. Far away single precision decides, because a
        // line that passed a face might pass its neighbour too.
        constexpr double far_in_sizes = 4;  // distance in sizes of the face
        const bool meets = !outside || met.t * met.t > far_in_sizes * far_in_sizes * length(m);
        // The position of faces that share a vertex with the edge's faces is exact, however near they are.
        const auto own = adjacent_faces(o);
        if (std::any_of(own.begin(), own.end(), [&](int32_t f) { return share_vertex(scene, face, f); }))
            return meets && met.t > PlaneHit::rounding * size_;
        const double touching = distance_in_contact(o, face, length(m) / std::fabs(dot(m, d)));
        if (std::fabs(met.t) > touching) return meets && met.t > 0;
        // The edge lies on this face. Lines into it end there, on the side on which the edge's faces stand.
        end.distance = 0;
        return !outside && rise(face, m, own) * dot(m, d) < 0;
    }

    // Returns the distance along the line that counts as contact, from the rounding of the input.
    double distance_in_contact(const PendingLine& o, int32_t face, double slant) const {
        const double size = extent(face);
        return contact(spacing_at(o, face), size, size) * slant;
    }
    // extent returns the largest coordinate of a face; spacing_at returns the relative spacing of such numbers.
    double extent(int32_t face) const {
        double size = 0;
        for (int i = 0; i < 3; ++i) {
            const Vec3 v = corner(view_.scene, face, i);
            size = std::max({size, std::fabs(v.x), std::fabs(v.y), std::fabs(v.z)});
        }
        return size;
    }
    double spacing_at(const PendingLine& o, int32_t face) const {
        const Spacing& spacing = *view_.scene.spacing;
        return std::max(spacing.of(view_.scene.faces[3 * int64_t(face)]), spacing.of(o.line.occluder.vertex[0]));
    }

    // Returns the largest height of faces over another's plane; 0: they lie in it.
    double rise(int32_t face, Vec3 m, std::span<const int32_t> others) const {
        const Vec3 q = corner(view_.scene, face, 0);
        double most = 0;
        for (const int32_t other : others)
            for (int i = 0; i < 3; ++i) {
                const double height = dot(m, corner(view_.scene, other, i) - q);
                if (std::fabs(height) > std::fabs(most)) most = height;
            }
        return std::fabs(most) > flat * dot(m, m) / std::sqrt(length(m)) ? most : 0;
    }

    // Sets one end of the line as the receiver. Returns false where the edge lies on it: there the camera sees an edge.
    bool set(PendingLine& o, int receiver) const {
        const End &near = o.end[receiver], &far = o.end[1 - receiver];
        if (near.distance == 0) return false;
        EdgeLine& line = o.line;
        line.receiver = near.face, line.reflector = far.face, line.at = near.at, line.from = line.radiance_at = far.at;
        line.distance = near.distance + far.distance, line.share = far.distance / line.distance;
        const Vec3 q = corner(view_.scene, near.face, 0);
        const Vec3 m = cross(corner(view_.scene, near.face, 1) - q, corner(view_.scene, near.face, 2) - q);
        line.facing = -dot(m, o.direction(receiver));
        if (far.distance == 0) line.radiance_at = adjacent(o, far.face);
        return true;
    }

    // Returns a point on a face that contains the edge, moved slightly to the side where light passes.
    Barycentrics adjacent(const PendingLine& o, int32_t face) const {
        const SceneView<T>& scene = view_.scene;
        const Vec3 q = corner(scene, face, 0), e1 = corner(scene, face, 1) - q, e2 = corner(scene, face, 2) - q;
        const Vec3 m = cross(e1, e2), across = unit(cross(m, o.tangent));
        const double side = dot(cross(o.tangent, o.line.w), across) > 0 ? 1 : -1;
        constexpr double little = 1e-5;   // fraction of the edge's length
        constexpr double roundings = 64;  // number of input roundings, for rays to lights
        const double aside = little * length(o.tangent) + roundings * spacing_at(o, face) * extent(face);
        const Vec3 there = o.p + (side * aside) * across - q;
        const double scale = 1 / dot(m, m);
        return inside({dot(cross(there, e2), m) * scale, dot(cross(e1, there), m) * scale});
    }

    static constexpr double flat = 1e-9;  // relative to the size of a face

    const BackwardView<T>& view_;
    const SceneView<T>& casters_;
    const std::vector<AlphaEdge>& alpha_edges_;
    const RayCaster& caster_;
    double size_, before_;
    PendingLine pending_[RayBatch::size];
    std::vector<int32_t> without_[RayBatch::size];
    std::vector<Vec3> opposite_;
    int count_ = 0;
};

}  // namespace edgegrad
