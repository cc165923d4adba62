// This file draws samples on the curves at which the light that a surface sends jumps.
//
// Points of paths stay at the barycentrics of their faces. Where a face B passes through a face A, one part of A is
// before B and the other behind it. Both change as B moves. Let n be unit normals, b a point of B's plane, and α and β
// the barycentrics of a point of the line on A and B. Φ is the light that paths through a point of A bring to the
// image. Then
//
//     δI = ∫ [Φ(F > 0) − Φ(F < 0)] δF / sin θ dℓ,   F(y) = n_B · (y − b),   δF = n_B · (Σ α_i δv_i − Σ β_i δw_i)
//
// θ is the angle between the planes, because |∇F| on A is its sine. The same holds for B. An alpha-tested face is
// opaque where f > 0 (occluder.h). Along its alpha edge dℓ / |∇f| = |κ M| dt, with M the cross product of the sides of
// the face. Only texture coordinates and alpha move f.
//
// For points that the camera sees there are curves in the image. Here Φ is the light that goes on to other surfaces. A
// direction is drawn by the cosine, and the point that it meets is lit from a point slightly next to the curve. From
// there light goes to the camera (light_tracing.h). Each side of a face counts, and each of its two parts.

#include "secondary/surface_edges.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "rays/trace.h"
#include "scene/intersections.h"
#include "secondary/estimator.h"
#include "secondary/line_ends.h"
#include "secondary/occluder.h"
#include "shading/lit/bsdf_sampling.h"

namespace edgegrad {

namespace {

constexpr int64_t fewest_places = 256, places_of_samples = 4;
// Light is evaluated this far next to the curve, in lengths of its piece and in roundings of the input.
constexpr double offset_of_length = 1e-5, offset_in_roundings = 64;

// A FacePart is one part of a face next to a point of a curve.
struct FacePart {
    int32_t face;
    int of;         // index of the face among those that meet there
    Vec3 across;    // unit vector on the face, from the curve into the part
    double factor;  // dℓ / |∇F|, negative where F < 0
};

// A CurvePoint is a point of a curve in the world, with the parts of faces that end there.
struct CurvePoint {
    struct VertexDerivative {
        int of;
        int32_t vertex;
        Vec3 by;
    };
    Vec3 p;
    std::vector<FacePart> parts;
    std::vector<VertexDerivative> rows;  // derivatives of F by vertices, for each face
    Occluder alpha_edge;                 // derivatives of f by the texture

    void append_motion(const FacePart& part, int64_t sample, CurveRecords& records) const {
        for (const VertexDerivative& row : rows) {
            if (row.of != part.of) continue;
            records.row_of.push_back(sample), records.vertex.push_back(row.vertex);
            append(records.by_q, {row.by.x, row.by.y, row.by.z});
        }
        alpha_edge.append_alpha_edge(1, sample, records);
    }
};

// SurfaceEdges holds the curves, laid end to end by their lengths.
template <class T>
class SurfaceEdges {
   public:
    SurfaceEdges(const BackwardView<T>& view, const SceneView<T>& casters, MovingEdges moving)
        : view_(view), casters_(casters) {
        const uint64_t seed = view.options.seed;
        if (moving.crossings) {
            const Intersections& found = view.geometry.intersections();
            if (found.are_drawn()) drawn_ = draw_all(found, seed_of(seed, Stream::surface_edge_intersections));
            crossings_ = found.are_drawn() ? &drawn_ : &found.all();
        }
        if (moving.alpha_edges)
            alpha_edges_ = AlphaEdgeFinder<T>(casters).find(seed_of(seed, Stream::surface_edge_alpha_edges), view.team);
    }

    int64_t size() const { return int64_t(crossings_->size() + alpha_edges_.size()); }

    // Returns the relative number of samples of each piece.
    Array<double> measure() const {
        Array<double> out(size());
        for (int64_t k = 0; k < size(); ++k) {
            const auto [a, b, stands_for] = piece(k);
            out[k] = stands_for * length(b - a);
        }
        return out;
    }

    // Sets the point t of a piece. Returns false where no surface ends.
    bool set(int64_t k, double t, CurvePoint& out) const {
        out.parts.clear(), out.alpha_edge = {};
        if (k < int64_t(crossings_->size())) return set_crossing((*crossings_)[k], t, out);
        return set_alpha_edge(alpha_edges_[k - int64_t(crossings_->size())], t, out);
    }

    // Returns the barycentrics of a point in the plane of a face.
    Barycentrics barycentrics(int32_t face, Vec3 p) const {
        const Vec3 q = corner(view_.scene, face, 0), e1 = corner(view_.scene, face, 1) - q,
                   e2 = corner(view_.scene, face, 2) - q, m = cross(e1, e2), there = p - q;
        const double scale = 1 / dot(m, m);
        return {dot(cross(there, e2), m) * scale, dot(cross(e1, there), m) * scale};
    }
    Vec3 normal(int32_t face) const {
        const Vec3 q = corner(view_.scene, face, 0);
        return cross(corner(view_.scene, face, 1) - q, corner(view_.scene, face, 2) - q);
    }
    // Returns how far next to the curve light is evaluated.
    double offset(int64_t k, int32_t face) const {
        double size = 0;
        for (int i = 0; i < 3; ++i) {
            const Vec3 v = corner(view_.scene, face, i);
            size = std::max({size, std::fabs(v.x), std::fabs(v.y), std::fabs(v.z)});
        }
        const auto [a, b, stands_for] = piece(k);
        return offset_of_length * length(b - a) +
               offset_in_roundings * view_.scene.spacing->of(view_.scene.faces[3 * int64_t(face)]) * size;
    }

   private:
    struct CurvePiece {
        Vec3 a, b;
        double stands_for;
    };
    CurvePiece piece(int64_t k) const {
        if (k < int64_t(crossings_->size())) {
            const Intersection& o = (*crossings_)[k];
            return {o.a, o.b, o.weight};
        }
        const AlphaEdge& alpha_edge = alpha_edges_[k - int64_t(crossings_->size())];
        return {position(alpha_edge.face, alpha_edge.begin), position(alpha_edge.face, alpha_edge.end),
                alpha_edge.share};
    }
    Array<Intersection> draw_all(const Intersections& found, uint64_t seed) const {
        Array<float> share(view_.scene.n_faces);
        std::fill(share.begin(), share.end(), 1.0f);
        const PlacedFaces faces{view_.scene.faces, view_.scene.n_faces, view_.scene.verts, *view_.scene.spacing,
                                view_.geometry.topology()};
        return found.drawn(faces, share, seed, view_.team);
    }
    Vec3 position(int32_t face, Barycentrics b) const {
        Vec3 out;
        for (int i = 0; i < 3; ++i) out += b[i] * corner(view_.scene, face, i);
        return out;
    }
    bool set_crossing(const Intersection& o, double t, CurvePoint& out) const {
        out.p = (1 - t) * o.a + t * o.b;
        Vec3 n[2];
        Barycentrics at[2];
        for (int k = 0; k < 2; ++k) {
            n[k] = unit(normal(o.face[k])), at[k] = inside(barycentrics(o.face[k], out.p));
            if (!shows(casters_, o.face[k], at[k])) return false;
        }
        const double sine = length(cross(n[0], n[1])), factor = o.weight * length(o.b - o.a) / sine;
        if (!(sine > least_angle)) return false;
        out.rows.clear();
        for (int own = 0; own < 2; ++own) {
            const Vec3 other = n[1 - own], across = (1 / sine) * (other - dot(other, n[own]) * n[own]);
            for (const double side : {1.0, -1.0}) out.parts.push_back({o.face[own], own, side * across, side * factor});
            for (int k = 0; k < 2; ++k)
                for (int i = 0; i < 3; ++i)
                    out.rows.push_back(
                        {own, view_.scene.faces[3 * int64_t(o.face[k]) + i], ((k == own ? 1 : -1) * at[k][i]) * other});
        }
        return true;
    }
    bool set_alpha_edge(const AlphaEdge& alpha_edge, double t, CurvePoint& out) const {
        AlphaEdgePoint there{};
        if (!AlphaEdgeFinder<T>(casters_).place(alpha_edge, t, there)) return false;
        const Vec3 q = corner(view_.scene, alpha_edge.face, 0), e1 = corner(view_.scene, alpha_edge.face, 1) - q,
                   e2 = corner(view_.scene, alpha_edge.face, 2) - q, M = cross(e1, e2);
        const Vec3 gradient = there.slope.u * cross(e2, M) + there.slope.v * cross(M, e1);  // gradient of f times |M|²
        out.p = position(alpha_edge.face, there.b), out.rows.clear(),
        out.alpha_edge = occluder_of(casters_, alpha_edge, there);
        out.parts.push_back(
            {alpha_edge.face, 0, unit(gradient), alpha_edge.share * std::fabs(there.kappa) * length(M)});
        return true;
    }

    static constexpr double least_angle = 1e-9;  // radians; planes at a smaller angle are taken for one

    const BackwardView<T>& view_;
    const SceneView<T>& casters_;
    const Array<Intersection> none_{0};
    Array<Intersection> drawn_{0};
    const Array<Intersection>* crossings_ = &none_;
    std::vector<AlphaEdge> alpha_edges_;
};

// A LitPoint is a point that a ray from a part of a face meets.
struct LitPoint {
    const CurvePoint& place;
    const FacePart& part;
    Barycentrics from;
    int32_t face;
    Barycentrics at;

    void append_to(CurveRecords& records, double weight) const {
        const int64_t sample = records.size();
        append(records.x, {0.0, 0.0});
        append(records.face, {face, part.face, -2});
        append(records.b, {at.u, at.v, from.u, from.v, 0.0, 0.0});
        append(records.factor, {M_PI * weight * part.factor, 0.0, 0.0});  // the cosine over its pdf
        place.append_motion(part, sample, records);
    }
};

// SurfaceEdgeRays traces rays from both sides of all parts of faces next to a point of a curve, to the points that they
// light.
template <class T>
class SurfaceEdgeRays {
   public:
    SurfaceEdgeRays(const LineLight<T>& light, const SurfaceEdges<T>& edges) : light_(light), edges_(edges) {
        for (const Light& light : light.lit.lit.lights) eps_ = std::max(eps_, light.eps);
    }

    // Calls body(LitPoint, weight) for those of the point t of a piece.
    template <class Body>
    void trace(int64_t piece, double t, Vec2 u, double weight, Body body) {
        if (!edges_.set(piece, t, place_)) return;
        part_.clear(), face_.clear(), b_.clear(), directions_.clear(), contact_.clear();
        for (const FacePart& part : place_.parts) {
            const Vec3 start = place_.p + edges_.offset(piece, part.face) * part.across;
            const Barycentrics b = edges_.barycentrics(part.face, start);
            // A neighbour continues the surface where the face ends at the curve.
            if (std::min({b.u, b.v, 1 - b.u - b.v}) < 0 || !light_.lit.lit.mesh_of(part.face).has_material) continue;
            const Vec3 n = unit(edges_.normal(part.face));
            for (const double side : {1.0, -1.0}) {
                const Vec3 w = draw_by_cosine(side * n, u);
                part_.push_back(&part), face_.push_back(part.face);
                append(b_, {b.u, b.v}), append(directions_, {w.x, w.y, w.z});
                contact_.push_back(16 * eps_ * std::max({std::fabs(start.x), std::fabs(start.y), std::fabs(start.z)}));
            }
        }
        const auto n = int64_t(part_.size());
        hit_.resize(n), hit_b_.resize(2 * n);
        trace_from_surface(light_.casters, light_.view.geometry.caster(),
                           {face_.data(), b_.data(), directions_.data(), contact_.data(), n}, hit_.data(),
                           hit_b_.data());
        for (int64_t i = 0; i < n; ++i)
            if (hit_[i] >= 0)
                body(
                    LitPoint{
                        place_, *part_[i], {b_[2 * i], b_[2 * i + 1]}, hit_[i], {hit_b_[2 * i], hit_b_[2 * i + 1]}},
                    weight);
    }

   private:
    const LineLight<T>& light_;
    const SurfaceEdges<T>& edges_;
    double eps_ = 0;
    CurvePoint place_;
    std::vector<const FacePart*> part_;
    std::vector<int32_t> face_, hit_;
    std::vector<double> b_, directions_, contact_, hit_b_;
};

// SurfaceEdgeSampler draws points that the parts of faces next to these curves light (estimator.h). It needs no pilots.
template <class T>
class SurfaceEdgeSampler {
   public:
    SurfaceEdgeSampler(const LineLight<T>& light, MovingEdges moving)
        : light_(light), edges_(light.view, light.casters, moving) {}

    bool is_empty() const { return edges_.size() == 0; }
    template <class Receiver>
    void cast_pilots(const Receiver&) {}
    int64_t lay_out(int64_t n) {
        places_.emplace(edges_.measure(), std::max(n / places_of_samples, fewest_places),
                        to_unit(seed(Stream::surface_edge_places)), light_.view.team);
        return places_->size();
    }

    template <class Body>
    void trace(int64_t first, int64_t last, Body body) const {
        const ShiftedSequence sequence(seed(Stream::surface_edge_rays));
        SurfaceEdgeRays rays(light_, edges_);
        places_->each(first, last, [&](int64_t i, int64_t piece, double t, double weight) {
            rays.trace(piece, t, sequence(uint64_t(i)), weight, body);
        });
    }

   private:
    uint64_t seed(Stream stream) const { return seed_of(light_.view.options.seed, stream); }

    const LineLight<T>& light_;
    const SurfaceEdges<T> edges_;
    std::optional<SystematicPlaces> places_;
};

}  // namespace

template <class T>
void add_surface_edges(const BackwardView<T>& view, const SceneView<T>& casters, const LitPaths& lit,
                       MovingEdges moving, int64_t samples, GradientSink& to, SecondaryEdgeSamples& out) {
    const int64_t n = samples >= 0 ? samples : default_secondary_samples(view);
    if (n == 0) return;
    const LineLight<T> light(view, casters, lit);
    SurfaceEdgeSampler<T> sampler(light, moving);
    const CurvesOnSurfaces receiver(
        [](const LitPoint& point, double weight, CurveRecords& records) { point.append_to(records, weight); });
    const size_t before = to.records->curves.size();
    record_secondary(view, sampler, receiver, [&] { return n; }, to);
    light_reflectors(light, to.records->curves, before, Stream::surface_edge_paths, out);
}

template void add_surface_edges(const BackwardView<float>&, const SceneView<float>&, const LitPaths&, MovingEdges,
                                int64_t, GradientSink&, SecondaryEdgeSamples&);
template void add_surface_edges(const BackwardView<double>&, const SceneView<double>&, const LitPaths&, MovingEdges,
                                int64_t, GradientSink&, SecondaryEdgeSamples&);

}  // namespace edgegrad
