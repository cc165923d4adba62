#include "forward/centers.h"

#include <algorithm>

#include "forward/sub_camera_rays.h"

namespace edgegrad {

template <class T>
void faces_at_centers(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, ThreadTeam& team,
                      int32_t* face) {
    const ImageOptions one{.spp = 1, .filter = Filter(FilterKind::box), .seed = 0};
    std::fill(face, face + int64_t(camera.width) * camera.height, -1);
    for (const SubCameraRays& sub_camera : make_sub_camera_rays(scene, camera, caster, one, team)) {
        // A face whose plane contains the eye is invisible; the image shows what is behind it, too.
        const auto is_seen = [&](int32_t f) {
            const int32_t* v = scene.faces + 3 * int64_t(f);
            const Vec3 corner[3] = {sub_camera.q[v[0]], sub_camera.q[v[1]], sub_camera.q[v[2]]};
            return !sub_camera.camera.passes_through_eye(corner);
        };
        team.parallel_for(camera.height, [&](int64_t y) {
            team.check();
            CameraRays rays(sub_camera.frame);
            for (int x = 0; x < camera.width; x += RayBatch::size) {
                rays.count = std::min(RayBatch::size, camera.width - x);
                for (int i = 0; i < rays.count; ++i) {
                    rays.n_x[i] = rays.n_y[i] = 0.5;
                    place_in_pixel(sub_camera.camera, one.filter, x + i, int(y), 1, rays.n_x + i, rays.n_y + i);
                }
                rays.prepare();
                sub_camera.frame.cast(rays);
                if (std::any_of(rays.face, rays.face + rays.count, [&](int32_t f) { return f >= 0 && !is_seen(f); })) {
                    rays.prepare();
                    sub_camera.frame.cast_with_alpha_test(rays, nullptr, is_seen);
                }
                for (int i = 0; i < rays.count; ++i)
                    if (rays.face[i] >= 0) face[y * camera.width + x + i] = rays.face[i];
            }
        });
    }
}

template void faces_at_centers(const SceneView<float>&, const Camera&, const RayCaster&, ThreadTeam&, int32_t*);
template void faces_at_centers(const SceneView<double>&, const Camera&, const RayCaster&, ThreadTeam&, int32_t*);

}  // namespace edgegrad
