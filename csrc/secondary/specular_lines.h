// This file draws lines past a point of an edge along which glossy faces mirror the viewer, or a light, to that point.
//
// A face with a narrow lobe sends light to the viewer, or takes it from a light, along few of the lines past an edge. A
// mirror would do so along one line, to the mirror image e′ of the viewer or light e. That line runs from the edge's
// point p along m = (e′ − p) / |e′ − p| and meets the mirror's plane at y. Directions are therefore drawn by the face's
// lobe there. If e is at a finite distance, a deviation ε at p changes the angle between normal and half vector by ε (1
// + |p − y| / |e − y|) / 2. The lobe at y alone would give ε / 2. The lobe is therefore that of a face smoother by the
// factor |e − y| / (|p − y| + |e − y|).
//
// This only shapes a pdf of directions. Faces that are curved, textured or occluded make it less efficient, not biased.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "rays/plane_hit.h"
#include "secondary/lune.h"
#include "shading/lit/bsdf_sampling.h"
#include "shading/lit/lit_scene.h"
#include "shading/lit/lit_surface.h"

namespace edgegrad {

// Mirrors holds the glossy faces of a scene, and the targets that they mirror.
class Mirrors {
   public:
    Mirrors(const LitScene& lit, bool viewer) {
        if (viewer) targets_.push_back({lit.tables[lit.eye].vector_at<double>(0), !lit.perspective, 0});
        for (const Light& light : lit.lights) add_target(lit, light);
        if (targets_.size() > most_pairs / 4) targets_.resize(most_pairs / 4);
        for (const LitMesh& mesh : lit.meshes)
            if (mesh.has_material && !mesh.lambertian)
                for (int64_t k = 0; k < mesh.faces; ++k) add_face(lit, mesh, mesh.first_face + k);
        if (targets_.empty()) faces_.clear();
        const auto most = targets_.empty() ? 0 : ptrdiff_t(most_pairs / targets_.size());
        if (ptrdiff_t(faces_.size()) <= most) return;
        std::nth_element(faces_.begin(), faces_.begin() + most, faces_.end(),
                         [](const GlossyFace& a, const GlossyFace& b) { return a.area > b.area; });
        faces_.resize(most);
    }

    bool empty() const { return faces_.empty(); }

   private:
    friend class SpecularLines;
    static constexpr size_t most_pairs = 32;  // maximum number of pairs of a face, largest first, and a target

    struct MirroredTarget {
        Vec3 place;  // position, or the unit direction towards it
        bool infinite;
        double extent;  // radius of a ball around it
    };
    struct GlossyFace {
        Vec3 corner[3], n;
        double alpha, area;
        bool two_sided;
    };

    void add_target(const LitScene& lit, const Light& light) {
        const std::vector<Table>& tables = lit.tables;
        switch (light.kind) {
            case Light::Kind::directional:
                return targets_.push_back({-unit(tables[light.direction].vector_at<double>(0)), true, 0});
            case Light::Kind::point:
            case Light::Kind::spot:
                return targets_.push_back({tables[light.position].vector_at<double>(0), false, 0});
            case Light::Kind::mesh: {
                const LitMesh& mesh = lit.meshes[light.mesh];
                Vec3 low{1e300, 1e300, 1e300}, high = -low;
                for (int64_t k = 3 * mesh.first_face; k < 3 * (mesh.first_face + mesh.faces); ++k) {
                    const Vec3 v = tables[lit.verts].vector_at<double>(lit.faces[k]);
                    low = {std::min(low.x, v.x), std::min(low.y, v.y), std::min(low.z, v.z)};
                    high = {std::max(high.x, v.x), std::max(high.y, v.y), std::max(high.z, v.z)};
                }
                return targets_.push_back({0.5 * (low + high), false, 0.5 * length(high - low)});
            }
            default:
                return;  // Other kinds emit from all around.
        }
    }

    void add_face(const LitScene& lit, const LitMesh& mesh, int64_t face) {
        const double middle[3] = {1.0 / 3, 1.0 / 3, 1.0 / 3};
        Surface<double> o;
        set_place<double>(lit, face, middle, nullptr, o);
        const Vec3* p = o.frame.corner;
        const double area = length(cross(p[1] - p[0], p[2] - p[0]));
        if (!(area > 0)) return;
        look_up_material(lit, o);
        if (o.scattering.roughness > widest_lobe) return;
        const double alpha = std::max(o.scattering.roughness * o.scattering.roughness, least_alpha);
        faces_.push_back({{p[0], p[1], p[2]}, o.frame.g, alpha, area, mesh.two_sided});
    }

    std::vector<MirroredTarget> targets_;
    std::vector<GlossyFace> faces_;
};

// SpecularLines draws unit directions of unoriented lines past one point, and returns their pdf by solid angle.
class SpecularLines {
   public:
    // `lune` belongs to the edge on which the point p lies. Lines outside of it are drawn rarely.
    void set(const Mirrors& mirrors, Vec3 p, const Lune& lune) {
        lobes_.clear(), sum_.clear(), share_ = 0;
        double sum = 0;
        for (const Mirrors::GlossyFace& face : mirrors.faces_)
            for (const Mirrors::MirroredTarget& target : mirrors.targets_)
                if (const double weight = add(face, target, p, lune); weight > 0)
                    share_ = std::max(share_, most_share * weight), sum_.push_back(sum += weight);
    }

    // Returns the fraction of lines to draw by these lobes.
    double share() const { return share_; }

    // Maps numbers in [0, 1) to a direction; `choice` selects the lobe. Returns zero if there is none.
    Vec3 draw(double choice, Vec2 u) const {
        const auto k = std::min<size_t>(std::upper_bound(sum_.begin(), sum_.end(), choice * sum_.back()) - sum_.begin(),
                                        sum_.size() - 1);
        const Vec3 l = lobes_[k].by.draw(u.x, u.y);
        return dot(lobes_[k].n, l) > 0 ? l : Vec3{};
    }
    double pdf(Vec3 w) const {
        double total = 0, before = 0;
        for (size_t k = 0; k < lobes_.size(); ++k) {
            const Vec3 l = dot(lobes_[k].n, w) > 0 ? w : -w;
            total += (sum_[k] - before) * lobes_[k].by.pdf(l), before = sum_[k];
        }
        return total / before;
    }

   private:
    static constexpr double most_share = 0.5;
    // This is the relative weight of a mirror that does not contain y, or of a line outside the lune.
    static constexpr double weight_outside = 0.1;

    struct FaceLobe {
        Vec3 n;  // normal of the face, on the side of p
        DrawnLobe by;
    };

    double add(const Mirrors::GlossyFace& face, const Mirrors::MirroredTarget& target, Vec3 p, const Lune& lune) {
        const double height = dot(face.n, p - face.corner[0]), side = height > 0 ? 1 : -1;
        const Vec3 n = side * face.n;
        const Vec3 e = target.place, to_e = target.infinite ? e : e - face.corner[0];
        const double own = side * height, other = dot(n, to_e);
        if (!(own > 0 && other > 0) || (side < 0 && !face.two_sided)) return 0;
        const Vec3 mirrored = target.infinite ? e - 2 * other * n : e - 2 * other * n - p;
        const Vec3 m = unit(mirrored);
        double alpha = face.alpha;
        if (!target.infinite) {
            const double spread = target.extent / (2 * length(mirrored));
            alpha *= other / (other + own), alpha = std::sqrt(alpha * alpha + spread * spread);
        }
        const Vec3 l = -m, v = 2 * dot(n, l) * n - l;
        lobes_.push_back({n, DrawnLobe(n, v, std::clamp(alpha, least_alpha, 1.0))});
        double weight = 1;
        // y is the reflection point: it should lie in the face or near it.
        const Vec3 e1 = face.corner[1] - face.corner[0], e2 = face.corner[2] - face.corner[0], M = cross(e1, e2),
                   y = p + (own / dot(n, l)) * m - face.corner[0];
        const double b1 = dot(cross(y, e2), M), b2 = dot(cross(e1, y), M), whole = dot(M, M);
        if (std::min({b1, b2, whole - b1 - b2}) < -tolerance * whole) weight *= weight_outside;
        if (!lune.locate(m).is_there()) weight *= weight_outside;
        return weight;
    }
    static constexpr double tolerance = 0.1;  // tolerance in barycentrics

    std::vector<FaceLobe> lobes_;
    std::vector<double> sum_;  // running sum of the lobes' weights
    double share_ = 0;
};

}  // namespace edgegrad
