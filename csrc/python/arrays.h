// The arrays of a scene, of a camera and of what the image hit, kept alive, checked, and seen as the kernel sees them.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "backward/backward.h"
#include "forward/forward.h"
#include "python/checks.h"
#include "python/unlocked.h"
#include "rays/geometry.h"

namespace edgegrad {

// What is rendered besides the radiance, for one camera.
struct ChannelArrays {
    In<double, 2> vertex, face;  // (V, Kv), (F, Kf)
    Attributes view;

    ChannelArrays(In<double, 2> vertex, In<double, 2> face, bool alpha, bool barycentrics, bool uv, int unit);
};

// The arrays of a scene, kept alive, checked, and seen as the kernel sees them.
template <class T>
struct SceneArrays {
    In<double, 2> verts;
    In<int32_t, 2> faces, corners;
    In<T, 2> colors;
    In<double, 2> uvs;
    In<T, 2> texels;
    In<int64_t, 2> textures;
    In<int32_t, 1> face_texture;
    In<int32_t, 2> uv_corners;  // (F, 3) or (0, 3)
    In<T, 2> alphas;
    In<int64_t, 2> alpha_masks;
    In<int32_t, 1> face_alpha_mask;
    In<T, 3> background;  // (1, 1, C) or (H, W, C)
    std::vector<double> cutoffs;
    Spacing spacing;
    bool by_vertex = false;

    SceneArrays(In<double, 2> verts_, In<int32_t, 2> faces_, In<int32_t, 2> corners_, In<T, 2> colors_,
                In<double, 2> uvs_, In<T, 2> texels_, In<int64_t, 2> textures_, In<int32_t, 1> face_texture_,
                In<int32_t, 2> uv_corners_, In<T, 2> alphas_, In<int64_t, 2> alpha_masks_,
                In<int32_t, 1> face_alpha_mask_, In<T, 3> background_, const std::vector<double>& cutoffs_,
                const std::vector<double>& spacing_, int threads);

    SceneView<T> view() const { return view_of(Attributes()); }
    SceneView<T> view(const ChannelArrays& channels, int threads) const;

    std::shared_ptr<const Geometry> geometry(GeometryWanted wanted, ThreadTeam& team, GeometryWork& work) const;

   private:
    void check_textures(const char* name, const In<int64_t, 2>& table, int64_t texels) const;
    void check_alpha_masks(int threads) const;
    bool all_have_uvs() const;
    SceneView<T> view_of(const Attributes& attributes) const;
};

template <class T>
struct HitArrays {
    Out<T, 2> coverage;
    Out<float, 2> depth;
    Out<int32_t, 3> hit;
    Out<uint8_t, 1> seen;

    void check(const SceneArrays<T>& scene, const Camera& camera) const;
    HitBuffers<T> view() const { return {coverage.data(), depth.data(), hit.data(), seen.data()}; }
};

template <class T>
void check_image(const char* name, const Out<T, 3>& image, const Camera& camera, size_t channels) {
    if (int(image.shape(0)) != camera.height || int(image.shape(1)) != camera.width || image.shape(2) != channels)
        refuse(std::string(name) + ": expected an image of the camera's size and the scene's channels");
}

// A number for each face; see BackwardInput::detailed and transparent faces.
template <class T>
const uint8_t* marked_faces(const char* name, const SceneArrays<T>& scene,
                            const std::optional<In<uint8_t, 1>>& marked) {
    if (!marked) return nullptr;
    if (marked->size() != scene.faces.shape(0)) refuse(std::string(name) + ": expected one number a face");
    return marked->data();
}

// Geometry as the terms of a derivative want it.
template <class T, class Work>
void with_geometry(const SceneArrays<T>& arrays, bool boundary, int threads, Work work) {
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork done;
        work(*arrays.geometry(geometry_for(true, boundary), team, done), team);
    });
}

// `by_distortion`: whether derivatives by the coefficients are asked for. Without them a lens that distorts nothing is
// a pinhole, as far as it shows all of the image.
Camera make_camera(In<double, 2> world_to_camera, In<double, 2> K, In<double, 1> distortion, bool perspective,
                   const std::string& lens, int width, int height, bool by_distortion);
Filter make_filter(const std::string& name);
ImageOptions make_image_options(int spp, const std::string& filter, uint64_t seed);

}  // namespace edgegrad
