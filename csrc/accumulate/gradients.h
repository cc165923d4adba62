// Lists the parameters of a gradient in one table, which Python reads, too.
#pragma once

#include <cstdint>

#include "camera/lens.h"
#include "scene/scene.h"

namespace edgegrad {

// Points to an array of numbers for each parameter; null: none.
template <class Number>
struct Slots {
    Number* verts = nullptr;
    Number* colors = nullptr;
    Number* uvs = nullptr;
    Number* texels = nullptr;
    Number* alphas = nullptr;
    Number* vertex_attributes = nullptr;
    Number* face_attributes = nullptr;
    Number* background = nullptr;
    Number* world_to_camera = nullptr;  // (4, 4)
    Number* K = nullptr;                // (3, 3)
    Number* distortion = nullptr;       // (8,), see lens.h

    bool geometry() const { return verts || world_to_camera || K || distortion; }
    // Returns whether discontinuities within faces move.
    bool discontinuities() const { return geometry() || uvs || alphas; }
    bool appearance() const { return colors || uvs || texels || vertex_attributes || face_attributes; }
};

// Points to the gradients, in double whatever the arrays hold; null where none is wanted.
using Gradients = Slots<double>;

// Points to the parameters' derivatives in one direction; null where they are zero.
using Tangents = Slots<const double>;

// Describes one parameter. A new differentiable parameter is a member above, a row here, and the code that computes it.
template <class T>
struct GradientSlot {
    const char* name;  // name of the array in edgegrad/kernel/request.py
    double* Gradients::* to;
    const double* Tangents::* from;
    int64_t (*size)(const SceneView<T>& scene, int64_t pixels);
};
template <class T>
inline constexpr GradientSlot<T> gradient_slots[] = {
    {"verts", &Gradients::verts, &Tangents::verts, [](const SceneView<T>& s, int64_t) { return 3 * s.n_verts; }},
    {"colors", &Gradients::colors, &Tangents::colors,
     [](const SceneView<T>& s, int64_t) { return s.radiance * s.n_colors; }},
    {"uvs", &Gradients::uvs, &Tangents::uvs, [](const SceneView<T>& s, int64_t) { return 2 * s.n_uvs; }},
    {"texels", &Gradients::texels, &Tangents::texels,
     [](const SceneView<T>& s, int64_t) { return s.radiance * s.n_texels; }},
    {"alphas", &Gradients::alphas, &Tangents::alphas,
     [](const SceneView<T>& s, int64_t) { return s.alpha_masks.n_alphas; }},
    {"vertex_attributes", &Gradients::vertex_attributes, &Tangents::vertex_attributes,
     [](const SceneView<T>& s, int64_t) { return s.attributes.vertex_width * s.n_verts; }},
    {"face_attributes", &Gradients::face_attributes, &Tangents::face_attributes,
     [](const SceneView<T>& s, int64_t) { return s.attributes.face_width * s.n_faces; }},
    {"background", &Gradients::background, &Tangents::background,
     [](const SceneView<T>& s, int64_t pixels) { return s.channels * (s.background_is_image ? pixels : 1); }},
    {"world_to_camera", &Gradients::world_to_camera, &Tangents::world_to_camera,
     [](const SceneView<T>&, int64_t) { return int64_t(16); }},
    {"K", &Gradients::K, &Tangents::K, [](const SceneView<T>&, int64_t) { return int64_t(9); }},
    {"distortion", &Gradients::distortion, &Tangents::distortion,
     [](const SceneView<T>&, int64_t) { return int64_t(most_coefficients); }},
};

}  // namespace edgegrad
