// Surface samples: points on the triangles rather than pixels that happen to hit them.
//
// Triangles are laid end to end by a measure m of which area + longest side · 1 px is a part (surface_measure.h). A
// point uniform in the image of its triangle then has the weight area · M / (n m). At a grazing angle the integrand
// grows as 1 / area, and the product stays bounded. Where a triangle has a control (control.h), samples find only what
// differs from it, and fewer do.

#include "interior/interior.h"

#include <algorithm>
#include <vector>

#include "camera/polygon.h"
#include "core/channels.h"
#include "core/sampler.h"
#include "core/systematic.h"
#include "interior/face_grad.h"
#include "interior/surface_measure.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

// The samples of one chunk.
template <int N, class T>
class InteriorChunk {
   public:
    InteriorChunk(const BackwardView<T>& view, bool geometry, const Destination& to, ChunkGrad& grad)
        : view_(view),
          grad_(view, geometry, to, grad),
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

// Adds what n samples find on the faces, which are laid end to end.
template <int N, class T>
void add_surface_samples(const BackwardView<T>& view, int64_t n, const Systematic& systematic,
                         const SurfaceMeasure<T>& surface, bool geometry, Destination& to, double (&seconds)[2]) {
    const ShiftedSequence sequence(hash(view.options.seed, 2, gradient_stream));
    view.scatter.add(n, to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        InteriorChunk<N, T> chunk(view, geometry, to, grad);
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
            chunk.add(face, x, sampler.lambda(), share, polygon.area, surface.is_controlled[face]);
        }
        chunk.finish();
    });
}

}  // namespace

template <int N, class T>
void add_interior(const BackwardView<T>& view, SurfaceMeasure<T>& surface, int64_t n, bool geometry, Destination& to,
                  BackwardProfile& profile) {
    const GradientOptions& o = view.options;
    profile.surface_samples = surface.pixel_samples() + n;
    if (o.dry) return;
    if (surface.pixel_samples() > 0)
        add_pixel_samples<N>(view, surface.pixels, surface.pixel_spp, hash(o.seed, 4, gradient_stream),
                             surface.is_large.data(), geometry, to, profile.surface);
    if (n == 0) return;
    Systematic systematic(surface.of_face, view.team);
    if (!(systematic.total() > 0)) return;
    systematic.draw(n, to_unit(hash(o.seed, 1, gradient_stream)));
    add_surface_samples<N>(view, n, systematic, surface, geometry, to, profile.surface);
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template void add_interior<N, float>(const BackwardView<float>&, SurfaceMeasure<float>&, int64_t, bool, Destination&, BackwardProfile&); \
    template void add_interior<N, double>(const BackwardView<double>&, SurfaceMeasure<double>&, int64_t, bool, Destination&, BackwardProfile&);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
