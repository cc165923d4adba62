// This file sets the sampling density of intersection lines of faces.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/sampler.h"
#include "primary/curve_measure.h"
#include "primary/hidden_curves.h"
#include "primary/intersection_source.h"
#include "primary/jump_scale.h"

namespace edgegrad {

// IntersectionSize weighs an intersection line against others. It uses the known difference of the radiance at its
// ends, and how far it moves with the faces. The motion is large where their planes nearly coincide.
template <class T>
class IntersectionSize {
   public:
    IntersectionSize(const BackwardView<T>& view, const JumpScale& scale) : view_(view), scale_(scale) {}

    // Returns the weight per pixel of its length.
    double operator()(const IntersectionCurve& c) {
        planes_.set(view_, c);
        const Vec2 n0 = normalised(view_.camera, c.x0), n1 = normalised(view_.camera, c.x1);
        const double moved =
            planes_.as_silhouette(view_.camera, c.a.z, n0) + planes_.as_silhouette(view_.camera, c.b.z, n1);
        const double weight = c.faces->weight;
        return weight * within(0.5 * moved / (weight * c.length), 64) *
               within(jump(*c.faces, n0, n1) / scale_.unknown, 2);
    }

   private:
    // Clamps a factor. The lower bound limits a sample's weight, because ends do not show what lies between them.
    static double within(double x, double most) { return x > 1.0 / 64 ? std::min(x, most) : 1.0 / 64; }

    // Returns the jump, or the mean where textures would have to be evaluated.
    double jump(const Intersection& i, Vec2 n0, Vec2 n1) {
        const SceneView<T>& scene = view_.scene;
        if (is_textured(scene, i.face[0]) || is_textured(scene, i.face[1])) return scale_.unknown;
        jump_.assign(2 * scene.channels, 0.0);
        for (int k = 0; k < 2; ++k) {
            const Barycentrics a = barycentrics_of_hit(planes_.map[k], n0), b = barycentrics_of_hit(planes_.map[k], n1);
            const double sign = k ? -1 : 1;
            each_corner_value<0>(scene, i.face[k], [&](int c, double c0, double c1, double c2) {
                jump_[2 * c] += sign * (c0 + a.u * (c1 - c0) + a.v * (c2 - c0));
                jump_[2 * c + 1] += sign * (c0 + b.u * (c1 - c0) + b.v * (c2 - c0));
            });
        }
        double sum = 0;
        for (int c = 0; c < scene.channels; ++c)
            sum += scale_.weights[c] * (std::fabs(jump_[2 * c]) + std::fabs(jump_[2 * c + 1]));
        return 0.5 * sum;
    }

    const BackwardView<T>& view_;
    const JumpScale& scale_;
    IntersectionPlanes planes_;
    std::vector<double> jump_;  // jump of each channel, at either end
};

// Draws a subset of too many intersections. Faces out of view, or most likely hidden, get fewer.
template <class T>
Array<Intersection> draw_intersections(const BackwardView<T>& view) {
    constexpr float hidden = 1.0f / 8;
    Array<float> share(view.scene.n_faces);
    view.team.parallel_for_blocks(view.scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
        const VertexView& p = view.vertices;
        for (int64_t f = first; f < last; ++f) {
            const int32_t* v = view.scene.faces + 3 * f;
            const auto behind = [&](int i) { return view.occlusion.hides_around(p.x[v[i]], p.q[v[i]].z); };
            const uint8_t some = p.outcode[v[0]] | p.outcode[v[1]] | p.outcode[v[2]];
            if (view.seen[f]) share[f] = 1;
            else if (some) share[f] = p.outcode[v[0]] & p.outcode[v[1]] & p.outcode[v[2]] ? hidden : 1;
            else share[f] = behind(0) && behind(1) && behind(2) ? hidden : float(next_to_unhit(view, f));
        }
    });
    return view.geometry.intersections().drawn(
        {view.scene.faces, view.scene.n_faces, view.scene.verts, *view.scene.spacing, view.geometry.topology()}, share,
        seed_of(view.options.seed, Stream::intersections), view.team);
}

// Appends the intersection lines where the adjoint is not zero to `out.intersection`. Their known jumps compare them
// with one another. Jumps of silhouettes are unknown, so the lines together count as half their length. Where they are
// many, most join surfaces that are near in space too.
constexpr double share_of_length = 0.5;
template <class T>
void measure_intersections(const BackwardView<T>& view, Curves<T>& out) {
    if (view.geometry.intersections().are_drawn()) out.drawn = draw_intersections(view);
    const Array<Intersection>& all = out.lines(view.geometry);
    const int64_t n = int64_t(all.size());
    if (n == 0) return;
    const JumpScale scale = jump_scale(view);
    struct Part {
        std::vector<MeasuredIntersection> lines;
        int64_t found = 0;
        double pixels = 0, sized = 0, squares = 0;  // Σ pixels, Σ pixels · size, Σ measure²
    };
    const std::vector<Part> parts = view.team.map_blocks(n, [&](int64_t first, int64_t last) {
        Part part;
        IntersectionSize<T> size_of(view, scale);
        for (int64_t i = first; i < last; ++i) {
            IntersectionCurve c;
            if (!find_intersection(view, out.finder.facing(), all[i], c)) continue;
            ++part.found;
            const auto [low, high] = view.camera.image_box(c.low(), c.high());
            const double importance = view.importance.mean(low, high);
            if (!(importance > 0)) continue;
            const int64_t hiding = hiding_pixels(view.occlusion, low, high, c.nearest_depth());
            const double samples =
                std::min(hiding ? view.occlusion.factor(occluded_curve, double(hiding), view.image.spp) : 1,
                         std::max(next_to_unhit(view, all[i].face[0]), next_to_unhit(view, all[i].face[1])));
            const double pixels = c.length * view.camera.stretch(c.low(), c.high()) * samples;
            const double size = size_of(c);
            part.pixels += all[i].weight * pixels, part.sized += pixels * size;
            part.squares += std::pow(pixels * size * importance, 2);
            part.lines.push_back({pixels * size * importance, int32_t(i)});
        }
        return part;
    });
    double pixels = 0, sized = 0;
    for (const Part& part : parts) pixels += part.pixels, sized += part.sized;
    const double scaled = sized > 0 ? share_of_length * pixels / sized : 0;
    for (const Part& part : parts) {
        out.pixels += part.pixels, out.intersections += part.found;
        out.squares += scaled * scaled * part.squares, out.unknown += scaled * scaled * part.squares;
        for (const MeasuredIntersection& i : part.lines) out.intersection.push_back({scaled * i.measure, i.index});
    }
}

}  // namespace edgegrad
