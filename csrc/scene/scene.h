// Plain views of the arrays of a scene, as edgegrad/scene.py lays them out.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/math.h"

namespace edgegrad {

// Relative spacing of the numbers in which the user gave the vertices, which may differ from mesh to mesh: value[i]
// from vertex first[i] on.
struct Spacing {
    std::vector<int32_t> first{0};
    std::vector<double> value{0};

    double of(int32_t vertex) const {
        if (value.size() == 1) return value[0];
        return value[std::upper_bound(first.begin(), first.end(), vertex) - first.begin() - 1];
    }

    bool operator==(const Spacing&) const = default;
};

// A corner of a face refers to a row of `colors`, or, where the face carries a texture, to a row of `uvs`.
// Colours of vertices, faces and corners differ only in that index. T is float or double.
template <class T>
struct SceneView {
    const double* verts;  // (V, 3) world units
    int64_t n_verts;
    const int32_t* faces;  // (F, 3) rows of verts
    int64_t n_faces;
    const int32_t* corners;  // (F, 3) rows of colors or of uvs
    const T* colors;         // (A, C) linear radiance
    int64_t n_colors;
    const double* uvs;  // (T, 2), v running up
    int64_t n_uvs;
    const T* texels;  // (X, C) all textures, row by row
    int64_t n_texels;
    const int64_t* textures;      // (N, 3) first texel, height, width
    const int32_t* face_texture;  // (F,) row of textures, −1 for none; null when the scene has no texture
    const T* background;          // (C,) or (H, W, C)
    bool background_is_image;
    int channels;  // C
    const Spacing* spacing;

    const T* background_at(int64_t pixel) const {
        return background_is_image ? background + pixel * channels : background;
    }
};

}  // namespace edgegrad
