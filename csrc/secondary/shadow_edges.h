// This file finds the edges that cast shadows: those with all faces on one side, as seen from a point of a light. Alpha
// edges of alpha-tested faces cast shadows from all points outside the plane of their face.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/sampler.h"
#include "estimator/view.h"
#include "rays/plane_hit.h"
#include "scene/light_parts.h"
#include "secondary/light_wedge.h"
#include "secondary/occluder.h"

namespace edgegrad {

// A ShadowPiece is a part of an edge or an alpha edge, before the points of a light for which it casts a shadow.
struct ShadowPiece {
    int64_t edge;  // edge; if negative, an alpha edge
    int32_t part;
    float t0, t1;    // interval on the edge
    double share;    // fraction of the light's points times number of edges that it stands for
    double measure;  // measure of its shadows, as far as it is known without a ray

    bool is_alpha_edge() const { return edge < 0; }
    int64_t alpha_edge() const { return -1 - edge; }
    static int64_t of_alpha_edge(int64_t alpha_edge) { return -1 - alpha_edge; }
};

// PartsBall is a ball around all parts of a light.
struct PartsBall {
    Vec3 centre;
    double radius = 0;

    explicit PartsBall(const LightParts& light) {
        for (int64_t k = 0; k < 3 * light.count; ++k)
            centre += (1 / double(3 * light.count)) * light.at(k / 3, int(k % 3));
        for (int64_t k = 0; k < 3 * light.count; ++k)
            radius = std::max(radius, length(light.at(k / 3, int(k % 3)) - centre));
    }
};

// FacesBeforeLight holds the planes of faces in world coordinates, and tells which side points of a light see.
template <class T>
class FacesBeforeLight {
   public:
    FacesBeforeLight(const SceneView<T>& scene, const LightParts& light, ThreadTeam& team)
        : scene_(scene), light_(light), ball_(light), plane_(scene.n_faces) {
        team.parallel_for_blocks(scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t f = first; f < last; ++f) {
                const Vec3 v = corner(scene, f, 0), e1 = corner(scene, f, 1) - v, e2 = corner(scene, f, 2) - v;
                plane_[f] = {cross(e1, e2), v, rounding_of_triple_product({1, 0, 0}, e1, e2)};
            }
        });
    }

    // Heights holds how high the corners of a part lie over a face's plane, times the face's size. It is zero for a
    // face without area. A face seen edge-on from the whole part is evaluated as if the light had moved a little. The
    // direction is the same for all faces, so only one of two edges of such a face casts its shadow.
    struct Heights {
        Vec3 at;
        bool edge_on;
        bool flat() const { return at.x == 0 && at.y == 0 && at.z == 0; }
    };
    Heights heights(int64_t face, int64_t part) const {
        const Plane& p = plane_[face];
        double h[3];
        bool edge_on = true;
        for (int i = 0; i < 3; ++i) {
            const Vec3 to = light_.infinite ? light_.at(part, i) : light_.at(part, i) - p.corner;
            h[i] = dot(p.normal, to);
            constexpr double roundings = 16;  // factor on the rounding with which a light's point lies on its face
            edge_on = edge_on &&
                      std::fabs(h[i]) <= roundings * p.rounding * (std::fabs(to.x) + std::fabs(to.y) + std::fabs(to.z));
        }
        edge_on |= face == light_.face[part];
        if (!edge_on) return {{h[0], h[1], h[2]}, false};
        const double side = dot(p.normal, aside);
        return {{side, side, side}, true};
    }

    // Returns the side from which the whole light sees a face; 0: neither is certain.
    int side(int64_t face) const {
        const Plane& p = plane_[face];
        const double s = dot(p.normal, light_.infinite ? ball_.centre : ball_.centre - p.corner);
        const double reach = length(p.normal) * ball_.radius * (1 + 1e-9);
        return s > reach ? 1 : s < -reach ? -1 : 0;
    }

    // Lights are taken to have moved in this direction, which lies along no axis and no diagonal.
    static constexpr Vec3 aside{0.5257, 0.6731, -0.5203};

   private:
    struct Plane {
        Vec3 normal, corner;
        double rounding;
    };
    const SceneView<T>& scene_;
    const LightParts& light_;
    const PartsBall ball_;
    Array<Plane> plane_;
};

// EdgeWedge holds the wedge of one edge or alpha edge before a part of a light; each thread has its own.
template <class T>
class EdgeWedge {
   public:
    EdgeWedge(const BackwardView<T>& view, const SceneView<T>& casters, const FacesBeforeLight<T>& faces,
              const std::vector<AlphaEdge>& alpha_edges)
        : view_(view), casters_(casters), faces_(faces), alpha_edges_(alpha_edges) {}

    bool set(const ShadowPiece& piece) {
        return piece.is_alpha_edge() ? set_alpha_edge(alpha_edges_[piece.alpha_edge()].face, piece.part)
                                     : set(piece.edge, piece.part);
    }

    // Returns false where the light lies in the plane of the face.
    bool set_alpha_edge(int64_t face, int64_t part) {
        const auto h = faces_.heights(face, part);
        if (h.flat() || h.edge_on) return false;
        wedge_.all();
        return true;
    }

    // Returns false where the edge is never a silhouette, or only by the perturbation of faces seen edge-on. Where its
    // faces may be masked, the point on the edge decides whether it is one (LightRays).
    bool set(int64_t edge, int64_t part) {
        heights_.clear();
        bool known = false;
        for (const HalfEdge& half : view_.geometry.topology().half_edges(edge)) {
            const auto h = faces_.heights(half.face, part);
            if (h.flat()) continue;
            known |= !h.edge_on;
            heights_.push_back(half.backwards ? -h.at : h.at);
        }
        if (!known) return false;
        if (alpha_masks_jump(casters_, view_.geometry.topology(), edge)) wedge_.all();
        else wedge_.clip(heights_);
        return wedge_.fraction() > 0;
    }
    LightWedge& operator*() { return wedge_; }
    LightWedge* operator->() { return &wedge_; }

   private:
    const BackwardView<T>& view_;
    const SceneView<T>& casters_;
    const FacesBeforeLight<T>& faces_;
    const std::vector<AlphaEdge>& alpha_edges_;
    std::vector<Vec3> heights_;
    LightWedge wedge_;
};

// ShadowEdgeFinder finds the edges and alpha edges that cast shadows of a light. An edge is tested if some of the light
// may lie between its faces. The tested parts of the light are evenly spaced, so many that there are about `tests`
// pairs in all. Alpha edges get a quarter as many.
template <class T>
class ShadowEdgeFinder {
   public:
    ShadowEdgeFinder(const BackwardView<T>& view, const SceneView<T>& casters, const LightParts& light,
                     const FacesBeforeLight<T>& faces, const std::vector<AlphaEdge>& alpha_edges)
        : view_(view), casters_(casters), light_(light), faces_(faces), alpha_edges_(alpha_edges) {}

    std::vector<ShadowPiece> find(int64_t tests) const {
        const int64_t edges = view_.geometry.topology().n_edges();
        const auto may = view_.team.map_blocks(edges, [&](int64_t begin, int64_t end) {
            std::vector<int64_t> part;
            for (int64_t e = begin; e < end; ++e)
                if (may_cast(e)) part.push_back(e);
            return part;
        });
        int64_t edges_tested = 0;
        for (const auto& part : may) edges_tested += int64_t(part.size());
        const int64_t parts_tested = std::clamp<int64_t>(tests / std::max<int64_t>(edges_tested, 1), 1, light_.count);
        std::vector<std::vector<ShadowPiece>> parts(may.size());
        view_.team.parallel_for(int64_t(may.size()), [&](int64_t k) {
            EdgeWedge<T> wedge(view_, casters_, faces_, alpha_edges_);
            std::vector<ShadowPiece> part;
            for (const int64_t e : may[k]) add(e, parts_tested, wedge, part);
            parts[k] = std::move(part);
        });
        for (auto& block : of_alpha_edges(tests / 4)) parts.push_back(std::move(block));
        int64_t edges_found = 0;
        for (const auto& block : parts)
            for (size_t i = 0; i < block.size(); ++i) edges_found += i == 0 || block[i].edge != block[i - 1].edge;
        // Neighbouring pieces see almost the same light. Many edges are sorted by part of the light, so that neighbours
        // lie together on the mesh. Few edges are sorted by edge.
        if (edges_found <= light_.count) {
            std::vector<ShadowPiece> found;
            for (const auto& block : parts) found.insert(found.end(), block.begin(), block.end());
            return found;
        }
        std::vector<int64_t> begin(light_.count + 1, 0);
        for (const auto& block : parts)
            for (const ShadowPiece& piece : block) ++begin[piece.part + 1];
        for (int64_t k = 0; k < light_.count; ++k) begin[k + 1] += begin[k];
        std::vector<ShadowPiece> found(begin.back());
        for (auto& block : parts) {
            for (const ShadowPiece& piece : block) found[begin[piece.part]++] = piece;
            std::vector<ShadowPiece>().swap(block);
        }
        return found;
    }

   private:
    // Returns false where all of the light surely sees both faces of an edge from the same sides.
    bool may_cast(int64_t edge) const {
        if (!view_.geometry.topology().joins_two(edge)) return true;
        if (alpha_masks_jump(casters_, view_.geometry.topology(), edge)) return true;
        const auto adjacent = view_.geometry.topology().faces(edge);
        const int one = faces_.side(adjacent[0]), other = faces_.side(adjacent[1]);
        return one == 0 || other == 0 || one != other;
    }

    // Returns whether an edge lies in the plane of a part, as on a flat panel. That part sends it no light.
    bool lies_in_plane(int64_t part, Vec3 a, Vec3 b) const {
        if (light_.infinite || !light_.extended) return false;
        const Vec3 c = light_.at(part, 0), n = cross(light_.at(part, 1) - c, light_.at(part, 2) - c);
        const auto on = [&](Vec3 p) {
            constexpr double tolerance = 1e-9;
            return std::fabs(dot(n, p - c)) <= tolerance * length(n) * length(p - c);
        };
        return on(a) && on(b);
    }

    void add(int64_t e, int64_t parts_tested, EdgeWedge<T>& wedge, std::vector<ShadowPiece>& out) const {
        const HalfEdge& h = view_.geometry.topology().half_edges(e)[0];
        const Vec3 a = corner(view_.scene, h.face, h.first()), b = corner(view_.scene, h.face, h.second());
        const double shift = to_unit(hash(seed_of(view_.options.seed, Stream::shadow_light_parts), e));
        const double step = double(light_.count) / double(parts_tested);
        for (int64_t i = 0; i < parts_tested; ++i) {
            const int64_t part = std::min(int64_t((double(i) + shift) * step), light_.count - 1);
            if (lies_in_plane(part, a, b) || !wedge.set(e, part)) continue;
            add(e, part, a, b, step, *wedge, out);
        }
    }

    void add(int64_t e, int64_t part, Vec3 a, Vec3 b, double standing_for, const LightWedge& wedge,
             std::vector<ShadowPiece>& out) const {
        const Vec3 from = light_.at(part, wedge.centre()), middle = 0.5 * (a + b);
        const Vec3 d = light_.infinite ? -from : middle - from;
        const double share = standing_for * light_.chance[part] * wedge.fraction();
        const double measure = share * light_.towards(part, from, middle) * length(cross(b - a, d)) / length(d);
        if (std::isfinite(measure) && measure > 0) out.push_back({e, int32_t(part), 0, 1, share, measure});
    }

    std::vector<std::vector<ShadowPiece>> of_alpha_edges(int64_t tests) const {
        const int64_t parts_tested =
            std::clamp<int64_t>(tests / std::max<int64_t>(int64_t(alpha_edges_.size()), 1), 1, light_.count);
        const Hash random(seed_of(view_.options.seed, Stream::shadow_alpha_light_parts), 0);
        const double step = double(light_.count) / double(parts_tested);
        return view_.team.map_blocks(int64_t(alpha_edges_.size()), [&](int64_t begin, int64_t end) {
            EdgeWedge<T> wedge(view_, casters_, faces_, alpha_edges_);
            std::vector<ShadowPiece> out;
            for (int64_t k = begin; k < end; ++k) {
                const AlphaEdge& alpha_edge = alpha_edges_[k];
                const Vec3 a = on_face(alpha_edge, alpha_edge.begin), b = on_face(alpha_edge, alpha_edge.end);
                const double shift = to_unit(random(uint64_t(k)));
                for (int64_t i = 0; i < parts_tested; ++i) {
                    const int64_t part = std::min(int64_t((double(i) + shift) * step), light_.count - 1);
                    if (lies_in_plane(part, a, b) || !wedge.set_alpha_edge(alpha_edge.face, part)) continue;
                    add(ShadowPiece::of_alpha_edge(k), part, a, b, step * alpha_edge.share, *wedge, out);
                }
            }
            return out;
        });
    }
    Vec3 on_face(const AlphaEdge& alpha_edge, Barycentrics b) const {
        Vec3 p;
        for (int i = 0; i < 3; ++i) p += b[i] * corner(view_.scene, alpha_edge.face, i);
        return p;
    }

    const BackwardView<T>& view_;
    const SceneView<T>& casters_;
    const LightParts& light_;
    const FacesBeforeLight<T>& faces_;
    const std::vector<AlphaEdge>& alpha_edges_;
};

}  // namespace edgegrad
