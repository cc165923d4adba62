// Holds plain views of a scene's arrays, as edgegrad/kernel/flat.py lays them out.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/math.h"

namespace edgegrad {

// Holds the relative spacing of the numbers in which the user gave the vertices. It may differ between meshes: value[i]
// applies from vertex first[i] on.
struct Spacing {
    std::vector<int32_t> first{0};
    std::vector<double> value{0};

    double of(int32_t vertex) const {
        if (value.size() == 1) return value[0];
        return value[std::upper_bound(first.begin(), first.end(), vertex) - first.begin() - 1];
    }

    double coarsest() const { return *std::max_element(value.begin(), value.end()); }

    bool operator==(const Spacing&) const = default;
};

// Lists what a face shows besides its radiance (shading/attributes.h), in the order of the channels.
struct Attributes {
    bool alpha = false;              // 1 wherever a face is seen
    const double* vertex = nullptr;  // (V, vertex_width) values at the vertices
    int vertex_width = 0;
    int unit = -1;                 // first of three columns of `vertex` with a unit direction, −1: none
    const double* face = nullptr;  // (F, face_width) values of whole faces
    int face_width = 0;            // at most most_of_face
    bool barycentrics = false;     // adds 3 channels
    bool uv = false;               // adds 2 channels, if all faces have texture coordinates

    static constexpr int most_of_face = 4;

    int channels() const { return alpha + vertex_width + face_width + 3 * barycentrics + 2 * uv; }
};

// Describes alpha-tested faces, which are transparent where an alpha texture is below a cutoff (rays/alpha_mask.h).
template <class T>
struct AlphaMaskArrays {
    const T* alphas = nullptr;  // (Y,) all alpha textures, row by row
    int64_t n_alphas = 0;
    const int64_t* textures = nullptr;  // (M, 6)
    const double* cutoffs = nullptr;    // (M,)
    const int32_t* face = nullptr;      // (F,) row of both, −1 for whole faces; null when there are no others

    bool on(int64_t f) const { return face && face[f] >= 0; }
};

// Views a scene whose T is float or double. A corner of a face refers to a row of `colors`, or of `uvs` where the face
// is textured. Colours of vertices, faces and corners differ only in that index.
template <class T>
struct SceneView {
    const double* verts;  // (V, 3) world units
    int64_t n_verts;
    const int32_t* faces;  // (F, 3) rows of verts
    int64_t n_faces;
    const int32_t* corners;  // (F, 3) rows of colors or of uvs
    const T* colors;         // (A, R) linear radiance
    int64_t n_colors;
    const double* uvs;  // (T, 2), v running up
    int64_t n_uvs;
    const T* texels;  // (X, R) all textures, row by row
    int64_t n_texels;
    const int64_t* textures;      // (N, 6)
    const int32_t* face_texture;  // (F,) row of textures, −1 for none; null when the scene has no texture
    const T* background;          // (C,) or (H, W, C)
    bool background_is_image;
    int channels;  // C of the image: R of radiance, then the attributes
    const Spacing* spacing;
    Attributes attributes = {};
    int radiance = channels;              // R
    const int32_t* uv_corners = corners;  // (F, 3) rows of uvs, for faces that have any
    AlphaMaskArrays<T> alpha_masks = {};

    const T* background_at(int64_t pixel) const {
        return background_is_image ? background + pixel * channels : background;
    }
};

// Returns whether two faces share a vertex, by index.
template <class T>
bool share_vertex(const SceneView<T>& scene, int64_t face, int64_t other) {
    const int32_t *v = scene.faces + 3 * face, *w = scene.faces + 3 * other;
    return std::any_of(v, v + 3, [&](int32_t i) { return std::find(w, w + 3, i) != w + 3; });
}

}  // namespace edgegrad
