// Tests alpha-tested faces. A point of one exists where an alpha texture, at its texture coordinates, is at least a
// cutoff. Rays pass through elsewhere.
#pragma once

#include "camera/face_map.h"
#include "rays/camera_rays.h"
#include "scene/scene.h"
#include "texture/texture.h"

namespace edgegrad {

template <class T>
Vec2 interpolated_uv(const SceneView<T>& scene, int64_t face, Barycentrics b) {
    const int32_t* row = scene.uv_corners + 3 * face;
    const auto uv = [&](int i) { return Vec2{scene.uvs[2 * int64_t(row[i])], scene.uvs[2 * int64_t(row[i]) + 1]}; };
    const Vec2 uv0 = uv(0);
    return uv0 + b.u * (uv(1) - uv0) + b.v * (uv(2) - uv0);
}

// Returns the alpha texture of an alpha-tested face.
template <class T>
Texture<T> alpha_of(const SceneView<T>& scene, int64_t face) {
    return texture_at(scene.alpha_masks.alphas, scene.alpha_masks.textures, scene.alpha_masks.face[face]);
}
template <class T>
double cutoff_of(const SceneView<T>& scene, int64_t face) {
    return scene.alpha_masks.cutoffs[scene.alpha_masks.face[face]];
}

// Returns whether a face exists at a point of it.
template <class T>
bool shows(const SceneView<T>& scene, int64_t face, Barycentrics b) {
    if (!scene.alpha_masks.on(face)) return true;
    const Texture<T> alpha = alpha_of(scene, face);
    double value;
    eval<1>(alpha, footprint(alpha, interpolated_uv(scene, face, b)), 1, &value);
    return value >= cutoff_of(scene, face);
}

// Implements the alpha test for a camera's rays.
template <class T>
class AlphaMasks final : public AlphaTest {
   public:
    // `q` (V,) holds the vertices in camera coordinates.
    AlphaMasks(const SceneView<T>& scene, const Camera& camera, const Vec3* q)
        : scene_(scene), camera_(camera), q_(q) {}

    bool shows(int32_t face, Vec2 n) const override {
        if (!scene_.alpha_masks.on(face)) return true;
        const int32_t* v = scene_.faces + 3 * int64_t(face);
        const Vec3 corner[3] = {q_[v[0]], q_[v[1]], q_[v[2]]};
        return edgegrad::shows(scene_, face, barycentrics_of_hit(face_map(camera_, corner), n));
    }

   private:
    const SceneView<T> scene_;
    const Camera& camera_;
    const Vec3* q_;
};

}  // namespace edgegrad
