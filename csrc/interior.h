// The interior term ∫ Ã · ∂L/∂Φ dx: what changes inside the faces.
#pragma once

#include <algorithm>
#include <array>

#include "control.h"
#include "image_hits.h"
#include "importance.h"
#include "occlusion.h"
#include "render.h"
#include "scatter.h"
#include "shading/shade.h"

namespace edgegrad {

// What both terms of the backward pass look at.
template <class T>
struct BackwardView {
    const SceneView<T>& scene;
    const Camera& camera;
    const Geometry& geometry;
    const ViewVolume& volume;
    const VertexView& vertices;
    const FilteredAdjoint<T>& adjoint;
    const Importance& importance;
    const BackwardOptions& options;
    Team& team;
    Scatter& scatter;
    const RayFrame& frame;
    const OcclusionHint& occlusion;
    const ImageHits* hits;           // null where neither term asks
    const uint8_t* seen;             // (F,): 0, or the side from which the forward pass hit the face
    const int32_t* hit;              // (H, W, 2): the first and the last of the faces hit in each pixel
    const Array<T>& vertex_adjoint;  // (V, C): Ã at the vertices of faces that were hit (vertex_image.h)
};

template <class T>
std::array<Vec3, 3> corners_of(const BackwardView<T>& view, int64_t face) {
    const int32_t* v = view.scene.faces + 3 * face;
    const auto& q = view.vertices.q;
    return {q[v[0]], q[v[1]], q[v[2]]};
}

template <class T>
uint8_t side_of(const BackwardView<T>& view, int64_t face) {
    const auto q = corners_of(view, face);
    return view.camera.side(q[0], q[1], q[2]);
}

// Whether the ray at n meets a face, decided in double.
template <class T>
bool meets(const BackwardView<T>& view, int64_t face, Vec2 n) {
    const auto corner = corners_of(view, face);
    return covers(face_map(view.camera, corner.data()), n) &&
           !(view.camera.perspective && passes_through_eye(corner.data()));
}

// The depth at which the ray at n meets a face.
template <class T>
double depth_of(const BackwardView<T>& view, int64_t face, Vec2 n) {
    const auto corner = corners_of(view, face);
    const Barycentrics b = barycentrics_of_hit(face_map(view.camera, corner.data()), n);
    return b[0] * corner[0].z + b[1] * corner[1].z + b[2] * corner[2].z;
}

// Whether a face lies before a depth by several times its size. If a ray that float says to meet it misses it after
// all, then mostly because it meets a neighbour, and one that passed through the face might slip past that neighbour
// too; so there float decides, as it did for the image.
template <class T>
bool lies_far_before(const BackwardView<T>& view, int64_t face, double depth) {
    const auto q = corners_of(view, face);
    const double gap = depth - std::max({q[0].z, q[1].z, q[2].z});
    const Vec3 a = q[1] - q[0], b = q[2] - q[1], c = q[0] - q[2];
    return gap > 0 && gap * gap > 16 * std::max({dot(a, a), dot(b, b), dot(c, c)});
}

// What a run of samples on one face finds. What they have in common is done once for the run: the face's map and its
// derivative, and one row a corner for the scatter.
template <int N, class T>
class FaceGrad {
   public:
    FaceGrad(const BackwardView<T>& view, bool geometry, const Destination& to, ChunkGrad& grad)
        : view_(view),
          geometry_(geometry),
          want_colors_(to.colors),
          want_uvs_(to.uvs),
          want_texels_(to.texels),
          want_k_(to.want_k),
          grad_(grad),
          C_(N ? N : view.scene.channels),
          control_(view.scene, view.vertices, view.vertex_adjoint.data()) {}

    int32_t face() const { return face_; }  // −1: none

    void start(int32_t face, bool controlled = false) {
        face_ = face, controlled_ = controlled, seen_ = false;
        textured_ = is_textured(view_.scene, face);
        rows_.reset(textured_ ? 2 : C_);
        if (controlled) control_.start(face);
    }

    // A sample seen at n, with the cotangent of its radiance.
    void add(Vec2 n, const double* radiance_bar) {
        if (!seen_) {
            const int32_t* v = view_.scene.faces + 3 * int64_t(face_);
            for (int i = 0; i < 3; ++i) corner_[i] = view_.vertices.q[v[i]];
            map_ = face_map(view_.camera, corner_), map_bar_ = {};
            seen_ = true;
        }
        Barycentrics b;
        if (!barycentrics(map_, n, b)) return;
        const Barycentrics b_bar = shade_vjp<N>(view_.scene, face_, b, radiance_bar, want_texels_, rows_, grad_);
        if (!geometry_) return;
        Vec2 n_bar;
        barycentrics_vjp(map_, n, b, b_bar, map_bar_, n_bar);
        if (want_k_) normalised_vjp(view_.camera, n, n_bar, grad_.k);
    }

    Control<N, T>& control() { return control_; }

    void flush() {
        if (face_ < 0) return;
        const int32_t *v = view_.scene.faces + 3 * int64_t(face_), *row = view_.scene.corners + 3 * int64_t(face_);
        if (geometry_) {
            Vec3 corner_bar[3];
            if (seen_) face_map_vjp(view_.camera, corner_, map_bar_, corner_bar);
            if (controlled_) {
                Vec2 x_bar[3];
                control_.add_to_places(x_bar);
                for (int i = 0; i < 3; ++i)
                    project_vjp(view_.camera, view_.vertices.q[v[i]], x_bar[i], corner_bar[i], grad_.k);
            }
            for (int i = 0; i < 3; ++i) grad_.q.template add<3>(v[i], &corner_bar[i].x);
        }
        if (textured_ ? want_uvs_ : want_colors_) {
            if (controlled_) control_.add_to_colors(rows_.value.data());
            for (int i = 0; i < 3; ++i)
                (textured_ ? grad_.uvs : grad_.colors).add(row[i], rows_.value.data() + i * (textured_ ? 2 : C_));
        }
        face_ = -1;
    }

   private:
    const BackwardView<T>& view_;
    const bool geometry_, want_colors_, want_uvs_, want_texels_, want_k_;
    ChunkGrad& grad_;
    const int C_;

    int32_t face_ = -1;
    bool textured_ = false, controlled_ = false, seen_ = false;
    Vec3 corner_[3];
    FaceMap map_, map_bar_;
    CornerGrad rows_;
    Control<N, T> control_;
};

template <class T>
struct SurfaceMeasure;

// Adds what n samples find on the measured surface, and those of the pixels; `geometry` says whether points and camera
// are wanted too.
template <int N, class T>
void add_interior(const BackwardView<T>& view, SurfaceMeasure<T>& surface, int64_t n, bool geometry, Destination& to,
                  BackwardProfile& profile);

// Adds what `spp` samples in each of some pixels find on the faces marked in `faces` (F,), or on all if it is null.
template <int N, class T>
void add_pixel_samples(const BackwardView<T>& view, const std::vector<int64_t>& pixels, int spp, uint64_t seed,
                       const uint8_t* faces, bool geometry, Destination& to, double (&seconds)[2]);

}  // namespace edgegrad
