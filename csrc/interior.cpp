// Surface samples: points on the triangles rather than pixels that happen to hit them.
//
// Triangles are laid end to end by the measure m = (area + longest side · 1 px) · (how much the loss looks there), in
// image units, clipped to the view; more where there is a texture, less where the forward pass saw nothing. A point
// uniform in the image of its triangle then has the weight area · M / (n m). At a grazing angle the integrand grows as
// 1 / area, and the product stays bounded. Where a triangle has a control (control.h), samples find only what differs
// from it, and fewer do.

#include "interior.h"

#include <algorithm>
#include <atomic>
#include <bit>
#include <vector>

#include "polygon.h"
#include "sampler.h"
#include "shading/shade.h"
#include "systematic.h"

namespace edgegrad {

namespace {

// What the measure of a triangle is lowered by if neither it nor a neighbour was seen, and what by if, besides, the
// part of the surface to which it belongs was seen from the other side alone, as a closed mesh is: never to zero, for
// it may be seen all the same. A side counts in full from a share of `some` of the faces that were seen of the part, if
// these are at least `enough` to tell.
constexpr double hidden = 1.0 / 8, turned_away = 1.0 / 64, some = 1.0 / 16;
constexpr int enough = 64;

// Default samples a unit of (area + longest side · 1 px): where colours are interpolated, and where a texture may vary
// from pixel to pixel. Chosen with the samples at edges so that a smaller error of either would cost the same time
// (docs/performance.md).
constexpr double colored = 0.5, textured = 4;

// From this area in the image on, px², a triangle with a texture is left to samples of the pixels. Each triangle's
// integral is estimated in exactly one way, chosen before any sample is drawn, so the sum stays unbiased.
constexpr double large = 256;

// A face with a control is sampled the less the better that is likely to be: the adjoint changes little, and the face
// is not wide, px. From `widest` on its corners say little.
constexpr double least = 1.0 / 16, wide = 32, widest = 64;

// The pixels that large triangles may touch, by tiles.
class PixelMask {
   public:
    PixelMask(const Camera& camera, double radius)
        : width_(camera.width),
          height_(camera.height),
          radius_(radius),
          columns_((camera.width + tile - 1) / tile),
          marked_(size_t(columns_) * ((camera.height + tile - 1) / tile), 0) {}

    void mark(const VisiblePolygon& polygon) {
        const auto index = [](double x, int most) {
            return int(std::clamp(std::floor(x), 0.0, double(most - 1))) / tile;
        };
        const int i0 = index(polygon.low.x - radius_, width_), i1 = index(polygon.high.x + radius_, width_);
        const int j0 = index(polygon.low.y - radius_, height_), j1 = index(polygon.high.y + radius_, height_);
        for (int j = j0; j <= j1; ++j)
            for (int i = i0; i <= i1; ++i)
                std::atomic_ref(marked_[size_t(j) * columns_ + i]).store(1, std::memory_order_relaxed);
    }

    std::vector<int64_t> pixels() const {
        std::vector<int64_t> out;
        for (size_t t = 0; t < marked_.size(); ++t)
            if (marked_[t])
                for (int y = int(t) / columns_ * tile; y < std::min((int(t) / columns_ + 1) * tile, height_); ++y)
                    for (int x = int(t) % columns_ * tile; x < std::min((int(t) % columns_ + 1) * tile, width_); ++x)
                        out.push_back(int64_t(y) * width_ + x);
        return out;
    }

   private:
    static constexpr int tile = 16;
    int width_, height_;
    double radius_;
    int columns_;
    std::vector<uint8_t> marked_;
};

// The samples of one chunk.
template <int N, class T>
class InteriorChunk {
   public:
    InteriorChunk(const BackwardView<T>& view, bool geometry, const Destination& to, ChunkGrad& grad, const T* adjoint)
        : view_(view),
          grad_(view, geometry, to, grad, adjoint),
          C_(N ? N : view.scene.channels),
          rays_(view.frame),
          weighted_(RayBatch::size * C_) {}

    // A sample at x, with barycentrics λ in the image, that stands for a share of the face's area.
    void add(int64_t face, Vec2 x, Barycentrics lambda, double share, double area, bool controlled) {
        const int i = rays_.count;
        double* weighted = weighted_.data() + i * C_;
        if (!view_.adjoint.template at<N>(x, weighted) && !controlled) return;
        for (int c = 0; c < C_; ++c) weighted[c] *= share * area;
        const Vec2 n = normalised(view_.camera, x);
        sample_[i] = {int32_t(face), controlled, lambda, share}, rays_.n_x[i] = n.x, rays_.n_y[i] = n.y;
        if (++rays_.count == RayBatch::size) cast();
    }

    void finish() {
        cast();
        grad_.flush();
    }

   private:
    void cast() {
        rays_.prepare();
        view_.geometry.caster().cast(rays_);
        for (int i = 0; i < rays_.count; ++i) {
            const Sample& s = sample_[i];
            const bool seen = sees(i);
            if (!seen && !s.controlled) continue;
            if (grad_.face() != s.face) grad_.flush(), grad_.start(s.face, s.controlled);
            if (seen) grad_.add(rays_.n(i), weighted_.data() + i * C_);
            if (s.controlled) grad_.control().subtract(s.lambda, s.share);
        }
        rays_.count = 0;
    }

    // Whether nothing lies before the sample. Its ray may miss its own face, when that is thinner than floats are
    // apart; then what counts is whether what it met instead lies behind, by more than floats can tell.
    bool sees(int i) const {
        const int32_t own = sample_[i].face;
        if (rays_.face[i] == own) return true;
        const Vec2 n = rays_.n(i);
        const double depth = depth_of(view_, own, n);
        const auto far_before = [&](int32_t face) { return lies_far_before(view_, face, depth); };
        const auto decide = [&](int32_t face) { return face == own || far_before(face) || meets(view_, face, n); };
        const int32_t met = view_.geometry.caster().beyond_float(view_.frame, n, rays_.face[i], {}, decide);
        if (met < 0 || met == own) return true;
        if (far_before(met)) return false;
        const double* p = view_.scene.verts + 3 * int64_t(view_.scene.faces[3 * int64_t(own)]);
        return depth_of(view_, met, n) > depth + view_.frame.error({p[0], p[1], p[2]});
    }

    struct Sample {
        int32_t face;
        bool controlled;
        Barycentrics lambda;
        double share;
    };
    const BackwardView<T>& view_;
    FaceGrad<N, T> grad_;
    const int C_;
    RayBatch rays_;
    Sample sample_[RayBatch::size];
    std::vector<double> weighted_;
};

// What the gradient of a face will ask for once its rays are cast.
template <class T>
void prefetch_face(const BackwardView<T>& view, int64_t face) {
    const int32_t *v = view.scene.faces + 3 * face, *row = view.scene.corners + 3 * face;
    for (int i = 0; i < 3; ++i) {
        prefetch(&view.vertices.q[v[i]]);
        if (!is_textured(view.scene, face)) prefetch(view.scene.colors + int64_t(row[i]) * view.scene.channels);
    }
}

// What the forward pass saw: near which vertices it hit a face, for one smaller than the distance of the image's
// samples is hit by chance, so it is asked together with its neighbours; and from which side it saw the surface.
struct Sight {
    std::vector<uint8_t> hit;   // those of faces that were hit
    std::vector<uint8_t> near;  // those of faces with such a vertex
    std::vector<uint8_t> rim;   // those of faces with such a vertex and another
    std::vector<int32_t> seen;  // faces that were hit, by part and side

    template <class T>
    explicit Sight(const BackwardView<T>& view)
        : hit(view.scene.n_verts, 0), rim(view.scene.n_verts, 0), seen(2 * view.geometry.parts().size(), 0) {
        const auto mark = [](std::vector<uint8_t>& marked, const int32_t* v) {
            for (int i = 0; i < 3; ++i) std::atomic_ref(marked[v[i]]).store(1, std::memory_order_relaxed);
        };
        view.team.each_block(view.scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            // Neighbours mostly count for the same, and threads that all add to one number wait for each other.
            int64_t counter = 0;
            int32_t n = 0;
            const auto count = [&] {
                if (n) std::atomic_ref(seen[counter]).fetch_add(n, std::memory_order_relaxed);
            };
            for (int64_t f = first; f < last; ++f) {
                if (!view.seen[f]) continue;
                const int32_t* v = view.scene.faces + 3 * f;
                mark(hit, v);
                const int64_t own = 2 * int64_t(view.geometry.parts().of(v[0])) + (view.seen[f] == 2);
                if (own != counter) count(), counter = own, n = 0;
                ++n;
            }
            count();
        });
        near = hit;
        view.team.each_block(view.scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t f = first; f < last; ++f) {
                const int32_t* v = view.scene.faces + 3 * f;
                const int n = hit[v[0]] + hit[v[1]] + hit[v[2]];
                if (n == 1 || n == 2) mark(near, v), mark(rim, v);
            }
        });
    }

    // What the measure of a hidden face is lowered by.
    template <class T>
    double lowered(const BackwardView<T>& view, int64_t face) const {
        const int32_t* n = &seen[2 * int64_t(view.geometry.parts().of(view.scene.faces[3 * face]))];
        if (n[0] + n[1] < enough) return hidden;
        const double share = double(n[side_of(view, face) - 1]) / (n[0] + n[1]);
        return std::clamp(share / some * hidden, turned_away, hidden);
    }

    // Whether a part of the face may have been seen; whether all of it may; whether nothing hidden lies beside it.
    bool partly(const int32_t* v) const { return near[v[0]] | near[v[1]] | near[v[2]]; }
    bool whole(const int32_t* v) const { return hit[v[0]] & hit[v[1]] & hit[v[2]]; }
    bool clear(const int32_t* v) const { return !(rim[v[0]] | rim[v[1]] | rim[v[2]]); }
};

// Whether a face may have a control: one without texture, all of it inside the view, and so small that its corners say
// what is between them. A face that comes near the eye is not affine in the image.
template <class T>
bool may_be_controlled(const BackwardView<T>& view, int64_t face, const VisiblePolygon& polygon, const Sight& sight) {
    const int32_t* v = view.scene.faces + 3 * face;
    const VertexView& p = view.vertices;
    if (!sight.whole(v) || polygon.longest > widest || is_textured(view.scene, face)) return false;
    if (p.outcode[v[0]] | p.outcode[v[1]] | p.outcode[v[2]]) return false;
    const auto [near, far] = std::minmax({p.q[v[0]].z, p.q[v[1]].z, p.q[v[2]].z});
    return !view.camera.perspective || far < 2 * near;
}

// How much the adjoint changes over a face relative to its size: from one corner to the others, to the pixels at the
// middles of the sides and of the face, and to the mean of its box. Corners alone may agree by chance, as the signs of
// an L1 loss do.
template <int N, class T>
double variation(const BackwardView<T>& view, const Array<T>& adjoint, const int32_t* v, double importance) {
    const int C = N ? N : view.scene.channels;
    const T *a = &adjoint[int64_t(v[0]) * C], *b = &adjoint[int64_t(v[1]) * C], *c = &adjoint[int64_t(v[2]) * C];
    const Vec2 x0 = view.vertices.x[v[0]], x1 = view.vertices.x[v[1]], x2 = view.vertices.x[v[2]];
    const Vec2 inside[4] = {0.5 * (x0 + x1), 0.5 * (x1 + x2), 0.5 * (x2 + x0), (1.0 / 3) * (x0 + x1 + x2)};
    const T* pixel[4];
    for (int i = 0; i < 4; ++i) {
        const int x = std::clamp(int(inside[i].x), 0, view.camera.width - 1);
        const int y = std::clamp(int(inside[i].y), 0, view.camera.height - 1);
        pixel[i] = view.adjoint.of(int64_t(y) * view.camera.width + x);
    }
    double size = 0, change = 0, apart = 0;
    for (int k = 0; k < C; ++k) {
        const double A[3] = {double(a[k]), double(b[k]), double(c[k])}, mean = (A[0] + A[1] + A[2]) / 3;
        size += std::fabs(A[0]) + std::fabs(A[1]) + std::fabs(A[2]);
        change += std::fabs(A[1] - A[0]) + std::fabs(A[2] - A[0]);
        for (const T* p : pixel) apart += std::fabs(p[k] - mean);
    }
    if (!(size > 0)) return 1;
    return std::max({change / size, apart / size, std::fabs(1 - view.importance.of(size / 3) / importance)});
}

// Ã at the vertices that may be those of a face with a control, (V, C).
template <int N, class T>
Array<T> adjoint_at_vertices(const BackwardView<T>& view, const Sight& sight) {
    const int C = N ? N : view.scene.channels;
    Array<T> adjoint(view.scene.n_verts * C);
    view.team.each_block(view.scene.n_verts, [&](int64_t, int64_t first, int64_t last) {
        std::vector<double> A(C);
        for (int64_t v = first; v < last; ++v) {
            if (!sight.hit[v] || view.vertices.outcode[v]) continue;
            view.adjoint.template at<N>(view.vertices.x[v], A.data());
            for (int c = 0; c < C; ++c) adjoint[v * C + c] = T(A[c]);
        }
    });
    return adjoint;
}

// Turns cotangents of places in the image (V, 2) into those of camera coordinates and of K.
template <class T>
void add_places(const BackwardView<T>& view, const Array<double>& x_bar, Destination& to) {
    const int64_t V = view.scene.n_verts, blocks = Team::blocks(V);
    std::vector<double> k_bar(6 * blocks, 0.0);
    view.team.each_block(V, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) {
            const Vec2 x{x_bar[2 * v], x_bar[2 * v + 1]};
            if (x.x == 0 && x.y == 0) continue;
            Vec3 q;
            project_vjp(view.camera, view.vertices.q[v], x, q, k_bar.data() + 6 * k);
            to.q[3 * v] += q.x, to.q[3 * v + 1] += q.y, to.q[3 * v + 2] += q.z;
        }
    });
    for (int64_t i = 0; i < 6 * blocks; ++i) to.k[i % 6] += k_bar[i];
}

// Adds what n samples find on the faces, which are laid end to end.
template <int N, class T>
void add_surface_samples(const BackwardView<T>& view, int64_t n, const Systematic& systematic,
                         const Array<uint8_t>& is_controlled, const Array<T>& adjoint, bool geometry, Destination& to,
                         double (&seconds)[2]) {
    const ShiftedSequence sequence(hash(view.options.seed, 2, gradient_stream));
    scatter_samples(n, view.team, to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        InteriorChunk<N, T> chunk(view, geometry, to, grad, adjoint.data());
        VisiblePolygon polygon;
        PolygonSampler sampler;
        int64_t face = -1;
        double share = 0;
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic.position(i);
            const int64_t f = face < 0 ? systematic.primitive(position) : systematic.primitive(position, face);
            if (f != face) {
                face = f;
                polygon.set(view.camera, view.volume, view.vertices, view.scene.faces + 3 * f);
                prefetch_face(view, f);
                share = systematic.weight(f);
                sampler.set(polygon, 1 / share);
            }
            const double s = (position - systematic.begin_of(face)) / systematic.measure_of(face);
            const Vec2 x = sampler(s, sequence(i));
            chunk.add(face, x, sampler.lambda(), share, polygon.area, is_controlled[face]);
        }
        chunk.finish();
    });
}

}  // namespace

template <int N, class T>
void add_interior(const BackwardView<T>& view, bool geometry, Destination& to, BackwardProfile& profile) {
    const int64_t F = view.scene.n_faces;
    const int C = N ? N : view.scene.channels;
    const BackwardOptions& o = view.options;
    Stopwatch watch;
    const Sight sight(view);
    const Array<T> adjoint = adjoint_at_vertices<N>(view, sight);
    Array<double> measure(F);
    const int64_t chunks = (F + scatter_chunk - 1) / scatter_chunk;
    std::vector<double> size(chunks, 0.0), size_of_large(chunks, 0.0);
    const bool any_texture = view.scene.face_texture;
    std::vector<uint8_t> is_large(any_texture ? F : 0, 0);
    Array<uint8_t> is_controlled(F);
    PixelMask mask(view.camera, o.filter.radius() - 0.5);
    // What the controls are of all of their faces, summed by the places of vertices in the image.
    Array<double> x_bar = zeros(geometry ? 2 * view.scene.n_verts : 0, view.team);
    Destination whole;
    whole.x = geometry ? x_bar.data() : nullptr, whole.colors = to.colors, whole.channels = to.channels;
    double seconds[2] = {};
    scatter_samples(F, view.team, whole, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        const int64_t k = first / scatter_chunk;
        Control<N, T> control(view.scene, view.vertices, adjoint.data());
        // In groups, so that what one face asks of memory is on its way while others are worked on.
        constexpr int group = 8, ahead = 16;
        VisiblePolygon polygons[group];
        Importance::Region regions[group];
        for (int64_t g = first; g < last; g += group) {
            const int64_t end = std::min(g + group, last);
            for (int64_t f = g; f < end; ++f) {
                const int32_t* v = view.scene.faces + 3 * f;
                if (f + ahead < last)
                    for (int i = 0; i < 3; ++i) {
                        const int32_t w = v[3 * ahead + i];
                        prefetch(&view.vertices.x[w]), prefetch(&view.vertices.q[w]);
                        prefetch(&view.vertices.outcode[w]), prefetch(&adjoint[int64_t(w) * C]);
                        prefetch(&sight.near[w]), prefetch(&sight.hit[w]);
                    }
                VisiblePolygon& polygon = polygons[f - g];
                regions[f - g] = polygon.set(view.camera, view.volume, view.vertices, v)
                                     ? view.importance.region(polygon.low, polygon.high)
                                     : Importance::Region{};
                view.importance.prefetch(regions[f - g]);
            }
            for (int64_t f = g; f < end; ++f) {
                const int32_t* v = view.scene.faces + 3 * f;
                const VisiblePolygon& polygon = polygons[f - g];
                measure[f] = 0, is_controlled[f] = 0;
                const double importance = view.importance.mean(regions[f - g]);
                if (!(importance > 0)) continue;
                double m = (polygon.area + polygon.longest) * (is_textured(view.scene, f) ? textured : colored);
                if (!sight.partly(v)) m *= sight.lowered(view, f);
                if (!std::isfinite(m)) continue;  // coordinates beyond 1e150 cannot be sampled
                if (is_textured(view.scene, f) && polygon.area >= large) {
                    is_large[f] = 1;
                    mask.mark(polygon);
                    size_of_large[k] += m;
                    continue;
                }
                if (!o.dry && may_be_controlled(view, f, polygon, sight)) {
                    is_controlled[f] = 1;
                    control.start(f), control.add_integral();
                    if (geometry) control.add_to_places(grad.x);
                    if (to.colors) control.add_to_colors(grad.colors);
                    if (sight.clear(v) && polygon.longest < wide)
                        m *=
                            std::clamp(std::max(2 * variation<N>(view, adjoint, v, importance), polygon.longest / wide),
                                       least, 1.0);
                }
                measure[f] = m * importance;
                size[k] += m;
            }
        }
    });
    if (geometry) add_places(view, x_bar, to);
    double total = 0, total_of_large = 0;
    for (int64_t k = 0; k < chunks; ++k) total += size[k], total_of_large += size_of_large[k];
    // How often each is sampled: as the defaults, or in proportion to them.
    const double wanted = o.surface_samples >= 0 ? double(o.surface_samples) / (total + total_of_large) : 1;
    Systematic systematic(measure, view.team);
    profile.measure = watch.lap();

    if (total_of_large > 0) {
        const std::vector<int64_t> pixels = mask.pixels();
        const int spp = int(std::clamp(std::round(wanted * total_of_large / double(pixels.size())), 1.0, 0x1p20));
        profile.surface_samples = spp * int64_t(pixels.size());
        if (!o.dry)
            add_pixel_samples<N>(view, pixels, spp, hash(o.seed, 4, gradient_stream), is_large.data(), geometry, to,
                                 profile.surface);
    }
    if (!(systematic.total() > 0)) return;

    const int64_t n = o.surface_samples >= 0 ? std::max(1ll, std::llround(wanted * total)) : int64_t(std::ceil(total));
    profile.surface_samples += n;
    if (o.dry) return;
    systematic.draw(n, to_unit(hash(o.seed, 1, gradient_stream)));
    add_surface_samples<N>(view, n, systematic, is_controlled, adjoint, geometry, to, profile.surface);
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template void add_interior<N, float>(const BackwardView<float>&, bool, Destination&, BackwardProfile&); \
    template void add_interior<N, double>(const BackwardView<double>&, bool, Destination&, BackwardProfile&);
EDGEGRAD_INSTANTIATE(0)
EDGEGRAD_INSTANTIATE(1)
EDGEGRAD_INSTANTIATE(3)
EDGEGRAD_INSTANTIATE(4)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
