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

// An edge before a point of a light.
struct ShadowEdge {
    int64_t edge;
    int32_t light;
    int32_t caster;  // vertex of a face beside the edge, not on it
    double measure;  // of its shadow, as far as it is known without a ray
    double weight;   // how many pairs of its light's points and edges it stands for, over the number of these points
};

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

// The edges of a scene that cast shadows of its lights. Of a light with many points each edge is asked before some of
// them, spread evenly over their order: `tests` pairs in all.
template <class T>
std::vector<ShadowEdge> find_shadow_edges(const BackwardView<T>& view, const LightPoints& lights, int64_t tests) {
    const SceneView<T>& scene = view.scene;
    const Topology& topology = view.geometry.topology();
    const FacesBeforeLights<T> faces(scene, view.team);
    const int64_t edges = topology.n_edges();
    std::vector<std::vector<ShadowEdge>> parts(Team::blocks(edges));
    view.team.each_block(edges, [&](int64_t k, int64_t begin, int64_t end) {
        for (int64_t e = begin; e < end; ++e) {
            const auto halves = topology.half_edges(e);
            const HalfEdge& h = halves[0];
            const auto vertex_of = [&](const HalfEdge& h, int c) { return scene.faces[3 * int64_t(h.face) + c]; };
            const Vec3 a = corner(scene, h.face, h.first()), b = corner(scene, h.face, h.second());
            for (int64_t group = 0; group < lights.lights; ++group) {
                const int64_t first = lights.first[group], points = lights.first[group + 1] - first;
                const int64_t asked = std::clamp<int64_t>(tests / std::max<int64_t>(edges, 1), 1, points);
                const double shift = to_unit(hash(hash(view.options.seed, 8, gradient_stream), e, group));
                for (int64_t i = 0; i < asked; ++i) {
                    const int64_t l =
                        first + std::min(int64_t((double(i) + shift) * double(points) / double(asked)), points - 1);
                    if (!(lights.power[l] > 0)) continue;
                    const bool infinite = lights.infinite[l];
                    const Vec3 light = lights.at(l);
                    int side = 0, caster = -1;
                    bool silhouette = true;
                    for (const HalfEdge& half : halves) {
                        bool edge_on;
                        const int turn =
                            faces.facing(half.face, light, infinite, half.face == lights.face[l], edge_on) *
                            (half.backwards ? -1 : 1);
                        if (turn == 0) continue;
                        if (side && turn != side) silhouette = false;
                        side = turn;
                        if (!edge_on) caster = vertex_of(half, (half.corner + 2) % 3);
                    }
                    if (!silhouette || caster < 0) continue;
                    const Vec3 d = infinite ? -light : 0.5 * (a + b) - light;
                    const double distance = infinite ? 1 : length(d), across = length(cross(b - a, d));
                    const double measure = lights.power[l] * across / (distance * distance * distance);
                    if (std::isfinite(measure) && measure > 0)
                        parts[k].push_back({e, int32_t(l), caster, measure, 1 / double(asked)});
                }
            }
        }
    });
    std::vector<ShadowEdge> found;
    for (const auto& part : parts) found.insert(found.end(), part.begin(), part.end());
    return found;
}

}  // namespace edgegrad
