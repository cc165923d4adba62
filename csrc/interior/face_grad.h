// This file accumulates the gradient of a run of samples on one face.
#pragma once

#include "estimator/view.h"
#include "interior/control.h"
#include "shading/shade.h"

namespace edgegrad {

// FaceGrad does common work once per run: the face's map and its derivative, and one row per corner for the scatter.
template <int N, class T>
class FaceGrad {
   public:
    FaceGrad(const BackwardView<T>& view, bool geometry, const GradientSink& to, LocalGradients& grad)
        : view_(view),
          geometry_(geometry),
          to_(to),
          grad_(grad),
          control_(view.scene, view.vertices, view.vertex_adjoint.data()) {}

    int32_t face() const { return face_; }  // −1: none

    void start(int32_t face, bool controlled = false) {
        face_ = face, controlled_ = controlled, seen_ = false;
        rows_.reset(view_.scene, face);
        if (controlled) control_.start(face);
    }

    // Adds a sample seen at n, with the cotangent of its radiance.
    void add(Vec2 n, const double* radiance_bar) {
        if (!seen_) {
            const int32_t* v = view_.scene.faces + 3 * int64_t(face_);
            for (int i = 0; i < 3; ++i) corner_[i] = view_.vertices.q[v[i]];
            map_ = face_map(view_.camera, corner_), map_bar_ = {};
            seen_ = true;
        }
        Barycentrics b;
        if (!barycentrics(map_, n, b)) return;
        const Barycentrics b_bar = shade_vjp<N>(view_.scene, face_, b, radiance_bar, to_.texels, rows_, grad_);
        if (!geometry_) return;
        Vec2 n_bar;
        barycentrics_vjp(map_, n, b, b_bar, map_bar_, n_bar);
        if (to_.want_k) normalised_vjp(view_.camera, n, n_bar, grad_.k);
    }

    Control<N, T>& control() { return control_; }

    void flush() {
        if (face_ < 0) return;
        const int32_t* v = view_.scene.faces + 3 * int64_t(face_);
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
        if (controlled_) control_.add_to_corners(rows_);
        rows_.add_to(view_.scene, face_, to_, grad_);
        face_ = -1;
    }

   private:
    const BackwardView<T>& view_;
    const bool geometry_;
    const GradientSink& to_;
    LocalGradients& grad_;

    int32_t face_ = -1;
    bool controlled_ = false, seen_ = false;
    Vec3 corner_[3];
    FaceMap map_, map_bar_;
    CornerGrad rows_;
    Control<N, T> control_;
};

}  // namespace edgegrad
