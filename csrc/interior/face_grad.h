// What a run of samples on one face adds to the gradient.
#pragma once

#include "backward/view.h"
#include "interior/control.h"
#include "shading/shade.h"

namespace edgegrad {

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

}  // namespace edgegrad
