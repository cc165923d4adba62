// Surface samples: points on the triangles rather than pixels that happen to hit them.
//
// Triangles are laid end to end by the measure m = (area + longest side · 1 px) · (how much the loss looks there),
// image units, clipped to the view. A point uniform in the image of its triangle then has the weight area · M / (n m).
// At a grazing angle the integrand grows as 1 / area, and the product stays bounded.

#include "interior.h"

#include <algorithm>
#include <vector>

#include "sampler.h"
#include "shading/shade.h"
#include "systematic.h"

namespace edgegrad {

namespace {

// The part of a triangle inside the view: a convex polygon in the image.
struct VisiblePolygon {
    Vec2 corner[ViewVolume::most_corners];
    int n = 0;
    double area = 0;     // px²
    double longest = 0;  // px
    Vec2 low, high;

    template <class T>
    VisiblePolygon(const BackwardView<T>& view, int64_t face) {
        const int32_t* v = view.scene.faces + 3 * face;
        const VertexView& p = view.vertices;
        const uint8_t c0 = p.outcode[v[0]], c1 = p.outcode[v[1]], c2 = p.outcode[v[2]];
        if (c0 & c1 & c2) return;
        if (!(c0 | c1 | c2)) {
            n = 3;
            for (int i = 0; i < 3; ++i) corner[i] = p.x[v[i]];
        } else {
            Vec3 polygon[ViewVolume::most_corners] = {p.q[v[0]], p.q[v[1]], p.q[v[2]]};
            n = view.volume.clip_triangle(polygon);
            for (int i = 0; i < n; ++i) {
                // Only a triangle through the eye itself has a corner there; it has no image to sample.
                if (!(view.camera.depth_weight(polygon[i]) > 0)) n = 0;
                else corner[i] = project(view.camera, polygon[i]);
            }
        }
        if (n < 3) return;
        low = high = corner[0];
        for (int i = 0; i < n; ++i) {
            const Vec2 a = corner[i], b = corner[i + 1 < n ? i + 1 : 0];
            longest = std::max(longest, length(b - a));
            low = {std::min(low.x, a.x), std::min(low.y, a.y)};
            high = {std::max(high.x, a.x), std::max(high.y, a.y)};
            if (i >= 2) area += 0.5 * std::fabs(wedge(corner[i - 1] - corner[0], a - corner[0]));
        }
    }

    // A point uniform over the polygon, from u uniform in the unit square: a triangle of the fan, then a point in it.
    Vec2 sample(Vec2 u) const {
        double pick = u.x * area;
        for (int i = 2; i < n; ++i) {
            const double a = 0.5 * std::fabs(wedge(corner[i - 1] - corner[0], corner[i] - corner[0]));
            if (pick < a || i == n - 1) {
                const double r = std::sqrt(std::min(1.0, a > 0 ? pick / a : 0.5));
                return corner[0] + r * (corner[i - 1] - corner[0] + u.y * (corner[i] - corner[i - 1]));
            }
            pick -= a;
        }
        return corner[0];
    }
};

// The samples of one chunk that wait for their ray.
template <int N, class T>
class InteriorChunk {
   public:
    InteriorChunk(const BackwardView<T>& view, bool geometry, const Destination& to, ChunkGrad& grad)
        : view_(view),
          geometry_(geometry),
          want_rows_(to.colors || to.uvs),
          want_texels_(to.texels),
          grad_(grad),
          C_(N ? N : view.scene.channels),
          weighted_(RayPacket::size * C_),
          adjoint_(C_) {}

    void add(int64_t face, Vec2 x, double weight) {
        if (!view_.adjoint.template at<N>(x, adjoint_.data())) return;
        const int lane = packet_.count++;
        face_[lane] = face;
        ray_[lane] = pixel_ray(view_.camera, x);
        for (int c = 0; c < C_; ++c) weighted_[lane * C_ + c] = weight * adjoint_[c];
        view_.frame.set(packet_, lane, ray_[lane]);
        if (packet_.count == RayPacket::size) cast();
    }

    void finish() {
        if (packet_.count) cast();
        flush();
    }

   private:
    void cast() {
        view_.geometry.caster().cast(packet_);
        for (int i = 0; i < packet_.count; ++i)
            if (packet_.face[i] == face_[i]) add_visible(face_[i], ray_[i], weighted_.data() + i * C_);
        packet_.count = 0;
    }

    void add_visible(int64_t face, const Ray& ray, const double* radiance_bar) {
        if (face != current_) flush(), start(face);
        Barycentrics b;
        if (!intersect(ray, corner_, b)) return;
        const Barycentrics b_bar = shade_vjp<N>(view_.scene, face, b, radiance_bar, want_texels_, rows_, grad_);
        if (!geometry_) return;
        Ray ray_bar;
        intersect_vjp(ray, corner_, b, b_bar, corner_bar_, ray_bar);
        pixel_ray_vjp(view_.camera, ray, ray_bar, grad_.k);
    }

    void start(int64_t face) {
        current_ = face;
        const int32_t* v = view_.scene.faces + 3 * face;
        for (int i = 0; i < 3; ++i) corner_[i] = view_.vertices.q[v[i]], corner_bar_[i] = {};
        rows_.reset(is_textured(view_.scene, face) ? 2 : C_);
    }

    // A run of samples on one face is written as three rows, not as three for each sample.
    void flush() {
        if (current_ < 0) return;
        const int32_t *v = view_.scene.faces + 3 * current_, *row = view_.scene.corners + 3 * current_;
        const bool textured = is_textured(view_.scene, current_);
        for (int i = 0; i < 3; ++i) {
            if (geometry_) grad_.q.add(v[i], &corner_bar_[i].x);
            if (want_rows_)
                (textured ? grad_.uvs : grad_.colors).add(row[i], rows_.value.data() + i * (textured ? 2 : C_));
        }
        current_ = -1;
    }

    const BackwardView<T>& view_;
    const bool geometry_, want_rows_, want_texels_;
    ChunkGrad& grad_;
    const int C_;

    RayPacket packet_{};
    Ray ray_[RayPacket::size];
    int64_t face_[RayPacket::size];
    std::vector<double> weighted_, adjoint_;

    int64_t current_ = -1;
    Vec3 corner_[3], corner_bar_[3];
    CornerGrad rows_;
};

}  // namespace

template <int N, class T>
int64_t add_interior(const BackwardView<T>& view, bool geometry, Destination& to) {
    const int64_t F = view.scene.n_faces;
    const BackwardOptions& o = view.options;
    std::vector<double> measure(F);
    // The sum that chooses the number of samples is taken in blocks, as in Systematic, to be the same at any threads.
    const int64_t block = 4096, blocks = (F + block - 1) / block;
    std::vector<double> size(blocks, 0.0);
#pragma omp parallel for num_threads(o.threads) schedule(dynamic, 4)
    for (int64_t k = 0; k < blocks; ++k)
        for (int64_t f = k * block; f < std::min(F, (k + 1) * block); ++f) {
            const VisiblePolygon polygon(view, f);
            if (!(polygon.area > 0)) continue;
            const double m = polygon.area + polygon.longest,
                         importance = view.importance.mean(polygon.low, polygon.high);
            measure[f] = m * importance;
            if (importance > 0 && std::isfinite(m)) size[k] += m;
        }
    double total = 0;
    for (const double s : size) total += s;
    Systematic systematic(measure, o.threads);
    if (!(systematic.total() > 0)) return 0;

    const int64_t n = o.surface_samples >= 0 ? o.surface_samples : int64_t(std::ceil(total));
    systematic.draw(n, to_unit(hash(o.seed, 1)));
    const ShiftedSequence sequence(hash(o.seed, 2));
    scatter_samples(n, o.threads, to, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        InteriorChunk<N, T> chunk(view, geometry, to, grad);
        int64_t face = systematic.primitive(systematic.position(first));
        VisiblePolygon polygon(view, face);
        for (int64_t i = first; i < last; ++i) {
            const int64_t f = systematic.primitive(systematic.position(i), face);
            if (f != face) face = f, polygon = VisiblePolygon(view, f);
            chunk.add(face, polygon.sample(sequence(i)), polygon.area * systematic.weight(face));
        }
        chunk.finish();
    });
    return n;
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template int64_t add_interior<N, float>(const BackwardView<float>&, bool, Destination&); \
    template int64_t add_interior<N, double>(const BackwardView<double>&, bool, Destination&);
EDGEGRAD_INSTANTIATE(0)
EDGEGRAD_INSTANTIATE(1)
EDGEGRAD_INSTANTIATE(3)
EDGEGRAD_INSTANTIATE(4)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
