// What a gradient can be asked for: one table, from which Python reads too.
#pragma once

#include <cstdint>

#include "scene/scene.h"

namespace edgegrad {

// Where gradients are added, in double whatever the arrays hold; null where none is wanted.
struct Gradients {
    double* verts = nullptr;
    double* colors = nullptr;
    double* uvs = nullptr;
    double* texels = nullptr;
    double* background = nullptr;
    double* world_to_camera = nullptr;  // (4, 4)
    double* K = nullptr;                // (3, 3)

    bool geometry() const { return verts || world_to_camera || K; }
    bool appearance() const { return colors || uvs || texels; }
};

// A new differentiable parameter is a member above, a row here, and what computes it.
template <class T>
struct GradientSlot {
    const char* name;  // of the array that it belongs to, in edgegrad/_request.py
    double* Gradients::* to;
    int64_t (*size)(const SceneView<T>& scene, int64_t pixels);
};
template <class T>
inline constexpr GradientSlot<T> gradient_slots[] = {
    {"verts", &Gradients::verts, [](const SceneView<T>& s, int64_t) { return 3 * s.n_verts; }},
    {"colors", &Gradients::colors, [](const SceneView<T>& s, int64_t) { return s.channels * s.n_colors; }},
    {"uvs", &Gradients::uvs, [](const SceneView<T>& s, int64_t) { return 2 * s.n_uvs; }},
    {"texels", &Gradients::texels, [](const SceneView<T>& s, int64_t) { return s.channels * s.n_texels; }},
    {"background", &Gradients::background,
     [](const SceneView<T>& s, int64_t pixels) { return s.channels * (s.background_is_image ? pixels : 1); }},
    {"world_to_camera", &Gradients::world_to_camera, [](const SceneView<T>&, int64_t) { return int64_t(16); }},
    {"K", &Gradients::K, [](const SceneView<T>&, int64_t) { return int64_t(9); }},
};

}  // namespace edgegrad
