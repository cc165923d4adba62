// This file estimates the interior term from surface samples: points on the triangles rather than pixels that happen to
// hit them. Large textured triangles get samples of the pixels instead.
//
// Triangles lie end to end by a measure m that contains area + longest side · 1 px (surface_measure.h). A point uniform
// in the image of its triangle has the weight area · M / (n m). At a grazing angle the integrand grows as 1 / area, and
// the product stays bounded. Where a triangle has a control (control.h), fewer samples find the difference only.

#include "interior/interior.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "camera/polygon.h"
#include "core/ordered_draws.h"
#include "core/sampler.h"
#include "core/sobol.h"
#include "core/systematic.h"
#include "estimator/near_misses.h"
#include "estimator/pixel_samples.h"
#include "film/film.h"
#include "interior/accumulation.h"
#include "interior/surface_measure.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

// InteriorChunk traces the samples of one chunk.
template <class T>
class InteriorChunk {
   public:
    InteriorChunk(const BackwardView<T>& view, SurfaceAccumulation& accumulation)
        : view_(view), accumulation_(accumulation), rays_(view.frame) {}

    void add(SurfaceSample sample) {
        const int i = rays_.count;
        const auto [x, area_scale] = distort(view_.camera, sample.u);
        sample.x = x, sample.weight *= area_scale;
        if (area_scale == 0 || !accumulation_.wants(i, sample)) return;
        const Vec2 n = normalised(view_.camera, sample.u);
        sample_[i] = sample, rays_.n_x[i] = n.x, rays_.n_y[i] = n.y;
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish() {
        cast();
        accumulation_.finish();
    }

   private:
    void cast() {
        rays_.prepare();
        view_.frame.cast(rays_);
        for (int i = 0; i < rays_.count; ++i) accumulation_.add(i, sample_[i], rays_.n(i), is_visible(i));
        rays_.count = 0;
    }

    // Returns whether nothing occludes the sample. Its ray may miss its own face, if that is thinner than the spacing
    // of floats. The sample is then visible if what the ray met lies behind, by more than the error of floats.
    bool is_visible(int i) const {
        const int32_t own = sample_[i].face;
        const Vec2 n = rays_.n(i);
        if (rays_.face[i] == own) return !is_narrowly_occluded(i);
        if (!is_there(view_, own, n)) return false;
        const double depth = depth_of(view_, own, n);
        const auto far_before = [&](int32_t face) { return lies_far_before(view_, face, depth); };
        const auto decide = [&](int32_t face) { return face == own || far_before(face) || meets(view_, face, n); };
        const int32_t met = view_.frame.exact_hit(n, rays_.face[i], {}, decide);
        if (met < 0 || met == own) return true;
        if (far_before(met)) return false;
        const double* p = view_.scene.verts + 3 * int64_t(view_.scene.faces[3 * int64_t(own)]);
        return depth_of(view_, met, n) > depth + view_.frame.error({p[0], p[1], p[2]});
    }

    // Returns whether a narrow face is occluded although its ray found it. The occluder's border runs so near that
    // floats take the ray for one next to it.
    bool is_narrowly_occluded(int i) const {
        const SurfaceSample& sample = sample_[i];
        if (sample.across.x == 0 && sample.across.y == 0) return false;
        const int32_t own = sample.face;
        const Vec2 n = rays_.n(i);
        const double* p = view_.scene.verts + 3 * int64_t(view_.scene.faces[3 * int64_t(own)]);
        const double before = depth_of(view_, own, n) - view_.frame.error({p[0], p[1], p[2]});
        bool hidden = false;
        for (const double side : {-1.0, 1.0}) {
            const Vec2 error = normalised(view_.camera, sample.u + side * sample.across) - n;
            each_near_miss(view_, n, error, {&own, 1}, [&](int32_t met) {
                hidden = hidden || (meets(view_, met, n) && depth_of(view_, met, n) < before);
            });
        }
        return hidden;
    }

    const BackwardView<T>& view_;
    SurfaceAccumulation& accumulation_;
    CameraRays rays_;
    SurfaceSample sample_[RayBatch::size];
};

// Returns the vector across a face narrower than some errors of rays, as long as that error, px; 0: the face is wide.
template <class T>
Vec2 across_narrow(const BackwardView<T>& view, int64_t face, const VisiblePolygon& polygon) {
    constexpr double errors_across = 4;
    if (polygon.starred || !(2 * polygon.area < errors_across * float_reach * polygon.longest)) return {};
    double error = 0;
    for (int i = 0; i < 3; ++i) {
        const double* p = view.scene.verts + 3 * int64_t(view.scene.faces[3 * face + i]);
        error = std::max(error, view.frame.error({p[0], p[1], p[2]}));
    }
    error = std::min(error / view.camera.pixel_at_depth(polygon.nearest), float_reach);
    if (!(2 * polygon.area < errors_across * error * polygon.longest)) return {};
    Vec2 along;
    for (int i = 0; i < polygon.n; ++i) {
        const Vec2 side = polygon.corner[(i + 1) % polygon.n] - polygon.corner[i];
        if (length(side) > length(along)) along = side;
    }
    return (error / length(along)) * Vec2{along.y, -along.x};
}

// Prefetches what the gradient of a face needs once its rays are cast.
template <class T>
void prefetch_face(const BackwardView<T>& view, int64_t face) {
    const int32_t *v = view.scene.faces + 3 * face, *row = view.scene.corners + 3 * face;
    for (int i = 0; i < 3; ++i) {
        prefetch(&view.vertices.q[v[i]]);
        if (!is_textured(view.scene, face)) prefetch(view.scene.colors + int64_t(row[i]) * view.scene.radiance);
    }
}

// Adds the contribution of n samples on the faces, which lie end to end.
template <class T>
void add_surface_samples(const BackwardView<T>& view, int64_t n, const Systematic& systematic,
                         const SurfaceMeasure<T>& surface, const Accumulation& accumulation, GradientSink& to,
                         double (&seconds)[2]) {
    const ShiftedSequence sequence(seed_of(view.options.seed, Stream::surface_points));
    const auto cell = [&](int64_t f) { return cell_of(view, view.scene.faces[3 * f]); };
    const OrderedDraws draws(systematic, n, {view.scene.n_faces}, cell, view.team);
    view.scatter.add(n, to, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
        const std::unique_ptr<SurfaceAccumulation> to_chunk = accumulate_surfaces(view, accumulation, to, grad);
        InteriorChunk chunk(view, *to_chunk);
        VisiblePolygon polygon;
        PolygonSampler sampler;
        int64_t face = -1;
        double share = 0;
        Vec2 across;
        draws.each(first, last, [&](int64_t f, int64_t i) {
            if (f != face) {
                face = f;
                polygon.set(view.camera, view.volume, view.vertices, view.scene.faces + 3 * f);
                prefetch_face(view, f);
                share = systematic.weight(f);
                sampler.set(polygon, 1 / share);
                across = across_narrow(view, f, polygon);
            }
            const double s = (systematic.position(i) - systematic.begin_of(face)) / systematic.measure_of(face);
            const Vec2 u = sampler(s, sequence(i));
            chunk.add({.face = int32_t(face),
                       .controlled = surface.is_controlled[face] != 0,
                       .u = u,
                       .x = {},
                       .lambda = sampler.lambda(),
                       .share = share,
                       .weight = share * polygon.area * sampler.weight(),
                       .across = across});
        });
        chunk.finish();
    });
}

}  // namespace

// Casts rays through pixels, and differentiates the radiance of their hits with the weight A / spp.
//
// For a large textured triangle this beats surface samples. Its rays are the most coherent ones, and those of
// neighbouring pixels are evenly spread over it (sobol.h). For others it is poor: a triangle at a grazing angle, or
// smaller than a pixel, is hit by chance.
template <class T>
void add_pixel_samples(const BackwardView<T>& view, const PixelSamples& samples, const Accumulation& accumulation,
                       GradientSink& to, double (&seconds)[2]) {
    const auto& [pixels, spp, seed, faces, share, beyond, by_importance] = samples;
    const int margin = beyond.value_or(0), stride = view.camera.width + 2 * margin;
    const Filter filter = beyond ? Filter(FilterKind::box) : view.image.filter;
    // A pixel gets one round more for each quarter of the mean above it, as bright content varies in a pixel too.
    constexpr int most_times = 64;
    const int width = view.camera.width, height = view.camera.height;
    const double usual = view.importance.mean(0, width, 0, height);
    const auto times_of = [&](int x, int y) {
        if (!by_importance || x < 0 || y < 0 || x >= width || y >= height) return 1;
        const double count = view.importance.mean(x, x + 1, y, y + 1) / usual;
        return int(std::clamp(std::ceil(4 * count - 3), 1.0, double(most_times)));
    };
    std::vector<ScrambledSobol> sobol{ScrambledSobol(seed)};
    for (uint64_t k = 1; by_importance && k < most_times; ++k) sobol.emplace_back(hash(seed, k, gradient_stream));
    view.scatter.add(int64_t(pixels.size()), to, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
        const std::unique_ptr<SurfaceAccumulation> chunk = accumulate_surfaces(view, accumulation, to, grad);
        CameraRays rays(view.frame);
        struct {
            int64_t pixel;
            double weight;
            Vec2 x;  // position in the plane of pixels
        } drawn[RayBatch::size];
        const auto cast = [&] {
            view.team.check();
            rays.prepare();
            view.frame.cast(rays);
            int64_t pixel = -1;
            for (int i = 0; i < rays.count; ++i) {
                const int32_t face = rays.face[i];
                if (face < 0 || (faces && !faces[face])) continue;
                if (drawn[i].pixel != pixel) chunk->begin_pixel(pixel = drawn[i].pixel, drawn[i].weight);
                chunk->add_in_pixel(face, rays.n(i), drawn[i].x);
            }
            rays.count = 0;
        };
        for (int64_t p = first; p < last; ++p) {
            const int64_t pixel = pixels[p];
            const int column = int(pixel % stride), row = int(pixel / stride), x = column - margin, y = row - margin;
            const int all = times_of(x, y) * spp;
            const double weight = 1 / (all * share);
            if (!chunk->begin_pixel(pixel, weight)) continue;
            const uint64_t place = z_order(column, row) * spp;
            for (int done = 0; done < all;) {
                // Each round has its own sequence, so that neighbours with fewer rounds complement one another too.
                const int in_turn = done % spp, n = std::min(spp - in_turn, RayBatch::size - rays.count);
                double *n_x = rays.n_x + rays.count, *n_y = rays.n_y + rays.count;
                sobol[done / spp].fill(place + in_turn, n, n_x, n_y);
                for (int i = 0; i < n; ++i) drawn[rays.count + i] = {pixel, weight, {x + n_x[i], y + n_y[i]}};
                place_in_pixel(view.camera, filter, x, y, n, n_x, n_y);
                rays.count += n, done += n;
                if (rays.count == RayBatch::size) cast();
            }
        }
        cast();
        chunk->finish();
    });
}

template <class T>
void add_interior(const BackwardView<T>& view, SurfaceMeasure<T>& surface, int64_t n, const Accumulation& accumulation,
                  GradientSink& to, BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    profile.surface_samples = surface.pixel_samples() + n;
    if (o.dry) return;
    if (surface.pixel_samples() > 0) {
        PixelSamples samples{surface.pixels, surface.pixel_spp, seed_of(o.seed, Stream::surface_pixels),
                             surface.by_pixels.data(), surface.pixel_share};
        if (view.detailed) samples.beyond = surface.beyond, samples.by_importance = true;
        add_pixel_samples(view, samples, accumulation, to, profile.surface);
    }
    if (n == 0) return;
    Systematic systematic(surface.of_face, view.team);
    if (!(systematic.total() > 0)) return;
    systematic.draw(n, to_unit(seed_of(o.seed, Stream::surface_faces)));
    add_surface_samples(view, n, systematic, surface, accumulation, to, profile.surface);
}

#define EDGEGRAD_INSTANTIATE(T)                                                                                      \
    template void add_interior(const BackwardView<T>&, SurfaceMeasure<T>&, int64_t, const Accumulation&,             \
                               GradientSink&, BackwardProfile&);                                                     \
    template void add_pixel_samples(const BackwardView<T>&, const PixelSamples&, const Accumulation&, GradientSink&, \
                                    double (&)[2]);
EDGEGRAD_INSTANTIATE(float)
EDGEGRAD_INSTANTIATE(double)
#undef EDGEGRAD_INSTANTIATE

}  // namespace edgegrad
