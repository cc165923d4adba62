// Edges that cast shadows: those at which all faces lie on one side, as seen from a point of a light.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "backward/view.h"
#include "core/sampler.h"
#include "rays/meeting.h"
#include "scene/light_points.h"

namespace edgegrad {

// An edge before a light.
struct ShadowEdge {
    int64_t edge;
    int64_t first, end;  // in ShadowEdges::points: those of the light's points from which it casts a shadow
    int32_t light;
    double measure;  // of its shadows, as far as they are known without a ray: the mean over all points of the light
    double weight;   // that each of its points has in such a mean
};

struct ShadowEdges {
    std::vector<ShadowEdge> edges;
    // The point of a light; and a vertex of a face beside the edge, but not on it, that is not seen edge-on from there.
    struct Point {
        int32_t light, caster;
    };
    std::vector<Point> points;
};

// A light's points as many edges ask for them.
struct PointsOfLight {
    int64_t first, count;
    bool infinite;
    std::vector<double> x, y, z;
    Vec3 centre;  // of a ball around them
    double radius = 0;

    PointsOfLight(const LightPoints& lights, int64_t light)
        : first(lights.first[light]),
          count(lights.first[light + 1] - first),
          infinite(count && lights.infinite[first]) {
        for (int64_t i = first; i < first + count; ++i) {
            const Vec3 p = lights.at(i);
            x.push_back(p.x), y.push_back(p.y), z.push_back(p.z), centre += (1 / double(count)) * p;
        }
        for (int64_t i = first; i < first + count; ++i) radius = std::max(radius, length(lights.at(i) - centre));
    }
};

// The i-th of `asked` places among so many, evenly spread.
inline int32_t place_of(int64_t i, int64_t asked, double shift, int64_t count) {
    return int32_t(std::min(int64_t((double(i) + shift) * double(count) / double(asked)), count - 1));
}

// Which way faces are turned to the points of lights, in world coordinates.
template <class T>
class FacesBeforeLights {
   public:
    FacesBeforeLights(const SceneView<T>& scene, Team& team) : scene_(scene), plane_(scene.n_faces) {
        team.each_block(scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t f = first; f < last; ++f) {
                const Vec3 v = corner(scene, f, 0), e1 = corner(scene, f, 1) - v, e2 = corner(scene, f, 2) - v;
                plane_[f] = {cross(e1, e2), v, rounding_of_triple_product({1, 0, 0}, e1, e2)};
            }
        });
    }

    // 1 or −1: the side; 0 for a face without area. One that is seen edge-on is taken for what it is once the light has
    // moved a little in a fixed direction, the same for all faces: then of two edges of such a face only one casts its
    // shadow. `on_edge` tells whether it is one.
    int8_t facing(int64_t face, Vec3 light, bool infinite, bool own, bool& edge_on) const {
        const Plane& p = plane_[face];
        const Vec3 to = infinite ? light : light - p.corner;
        const double s = dot(p.normal, to);
        constexpr double slack = 16;  // of how exactly a point of a light lies on its face
        edge_on = own || std::fabs(s) <= slack * p.rounding * (std::fabs(to.x) + std::fabs(to.y) + std::fabs(to.z));
        const double side = edge_on ? dot(p.normal, aside) : s;
        return side > 0 ? 1 : side < 0 ? -1 : 0;
    }

    // That from which all points of a ball see a face; 0: not from one.
    int side_of_ball(int64_t face, const PointsOfLight& source) const {
        const Plane& p = plane_[face];
        const double s = dot(p.normal, source.infinite ? source.centre : source.centre - p.corner);
        const double reach = length(p.normal) * source.radius * (1 + 1e-9);
        return s > reach ? 1 : s < -reach ? -1 : 0;
    }

    // Appends those of `asked` points of a light that may see one of two faces that go on from one another from its
    // front and the other from its back.
    EDGEGRAD_VECTORIZED void between(int64_t one, int64_t other, const PointsOfLight& source, int64_t asked,
                                     double shift, std::vector<int32_t>& out) const {
        const Plane &p = plane_[one], &q = plane_[other];
        const Vec3 m = p.normal, n = q.normal;
        const double at_p = source.infinite ? 0 : dot(m, p.corner), at_q = source.infinite ? 0 : dot(n, q.corner);
        // What rounding leaves open is for facing() to decide.
        const auto sum = [](Vec3 v) { return std::fabs(v.x) + std::fabs(v.y) + std::fabs(v.z); };
        const double size = sum(source.centre) + source.radius + sum(p.corner) + sum(q.corner);
        const double open = 1e-12 * size, slack_p = open * sum(m), slack_q = open * sum(n);
        constexpr int lanes = 16;
        uint8_t may[lanes];
        for (int64_t i0 = 0; i0 < asked; i0 += lanes) {
            const int count = int(std::min<int64_t>(lanes, asked - i0));
            double x[lanes], y[lanes], z[lanes];
            for (int i = 0; i < count; ++i) {
                const int32_t j = place_of(i0 + i, asked, shift, source.count);
                x[i] = source.x[j], y[i] = source.y[j], z[i] = source.z[j];
            }
            for (int i = 0; i < lanes; ++i) {
                const double s = m.x * x[i] + m.y * y[i] + m.z * z[i] - at_p,
                             t = n.x * x[i] + n.y * y[i] + n.z * z[i] - at_q;
                may[i] = !(s > slack_p && t > slack_q) & !(s < -slack_p && t < -slack_q);
            }
            for (int i = 0; i < count; ++i)
                if (may[i]) out.push_back(place_of(i0 + i, asked, shift, source.count));
        }
    }

    // In which direction lights are taken to have moved: along no axis nor diagonal.
    static constexpr Vec3 aside{0.5257, 0.6731, -0.5203};

   private:
    struct Plane {
        Vec3 normal, corner;
        double rounding;
    };
    const SceneView<T>& scene_;
    Array<Plane> plane_;
};

// The edges of a scene that cast shadows of its lights. Of a light with many points each edge between whose faces some
// of them may lie is asked before as many, spread evenly over their order, as give `tests` pairs in all.
template <class T>
class ShadowEdgeFinder {
   public:
    ShadowEdgeFinder(const BackwardView<T>& view, const LightPoints& lights)
        : view_(view), lights_(lights), faces_(view.scene, view.team) {
        for (int64_t k = 0; k < lights.lights; ++k) sources_.emplace_back(lights, k);
    }

    ShadowEdges find(int64_t tests) const {
        ShadowEdges found;
        for (int32_t k = 0; k < int32_t(sources_.size()); ++k) add(k, tests / int64_t(sources_.size()), found);
        return found;
    }

   private:
    void add(int32_t light, int64_t tests, ShadowEdges& found) const {
        const PointsOfLight& source = sources_[light];
        const int64_t edges = view_.geometry.topology().n_edges();
        if (source.count == 0) return;
        // Those that may, block by block.
        std::vector<std::vector<int64_t>> may(Team::blocks(edges));
        view_.team.each_block(edges, [&](int64_t k, int64_t begin, int64_t end) {
            for (int64_t e = begin; e < end; ++e)
                if (may_cast(source, e)) may[k].push_back(e);
        });
        int64_t asking = 0;
        for (const auto& part : may) asking += int64_t(part.size());
        const int64_t asked = std::clamp<int64_t>(tests / std::max<int64_t>(asking, 1), 1, source.count);
        std::vector<ShadowEdges> parts(may.size());
        view_.team.each(int64_t(may.size()), [&](int64_t k) {
            std::vector<int32_t> candidates;
            for (const int64_t e : may[k]) add_edge(source, light, e, asked, candidates, parts[k]);
        });
        for (const ShadowEdges& part : parts) {
            const int64_t before = int64_t(found.points.size());
            found.points.insert(found.points.end(), part.points.begin(), part.points.end());
            for (ShadowEdge edge : part.edges) {
                edge.first += before, edge.end += before;
                found.edges.push_back(edge);
            }
        }
    }

    // False where all points of the light surely see both faces of an edge from the same sides as one another.
    bool may_cast(const PointsOfLight& source, int64_t edge) const {
        if (source.count == 1 || !view_.geometry.topology().joins_two(edge)) return true;
        const auto beside = view_.geometry.topology().faces(edge);
        const int one = faces_.side_of_ball(beside[0], source), other = faces_.side_of_ball(beside[1], source);
        return one == 0 || other == 0 || one != other;
    }

    void add_edge(const PointsOfLight& source, int32_t light, int64_t e, int64_t asked,
                  std::vector<int32_t>& candidates, ShadowEdges& out) const {
        const SceneView<T>& scene = view_.scene;
        const auto halves = view_.geometry.topology().half_edges(e);
        const HalfEdge& h = halves[0];
        const Vec3 a = corner(scene, h.face, h.first()), b = corner(scene, h.face, h.second());
        const double shift = to_unit(hash(hash(view_.options.seed, 8, gradient_stream), e, light));
        candidates.clear();
        if (asked > 1 && view_.geometry.topology().joins_two(e))
            faces_.between(halves[0].face, halves[1].face, source, asked, shift, candidates);
        else
            for (int64_t i = 0; i < asked; ++i) candidates.push_back(place_of(i, asked, shift, source.count));
        ShadowEdge found{e, int64_t(out.points.size()), 0, light, 0, 1 / double(asked)};
        for (const int32_t i : candidates) {
            const int64_t l = source.first + i;
            if (!(lights_.power[l] > 0)) continue;
            const Vec3 place = lights_.at(l);
            int side = 0, caster = -1;
            bool silhouette = true;
            for (const HalfEdge& half : halves) {
                bool edge_on;
                const int turn =
                    faces_.facing(half.face, place, source.infinite, half.face == lights_.face[l], edge_on) *
                    (half.backwards ? -1 : 1);
                if (turn == 0) continue;
                if (side && turn != side) silhouette = false;
                side = turn;
                if (!edge_on) caster = scene.faces[3 * int64_t(half.face) + (half.corner + 2) % 3];
            }
            if (!silhouette || caster < 0) continue;
            const Vec3 d = source.infinite ? -place : 0.5 * (a + b) - place;
            const double distance = source.infinite ? 1 : length(d), across = length(cross(b - a, d));
            const double measure = lights_.power[l] * across / (distance * distance * distance);
            if (!(std::isfinite(measure) && measure > 0)) continue;
            out.points.push_back({int32_t(l), caster});
            found.measure += measure / double(asked);
        }
        found.end = int64_t(out.points.size());
        if (found.end > found.first) out.edges.push_back(found);
    }

    const BackwardView<T>& view_;
    const LightPoints& lights_;
    const FacesBeforeLights<T> faces_;
    std::vector<PointsOfLight> sources_;
};

}  // namespace edgegrad
