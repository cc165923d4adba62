#include "forward/sub_camera_rays.h"

#include <cmath>

#include "camera/sub_cameras.h"
#include "camera/vertices.h"

namespace edgegrad {

template <class T>
SubCameraRays::SubCameraRays(const SceneView<T>& scene, const Camera& camera_, const RayCaster& caster,
                             const ImageOptions& o, ThreadTeam& team)
    : camera(camera_),
      q(camera_vertices(camera, scene.verts, scene.n_verts, team)),
      frame(caster, camera, see_through(scene)),
      pixel_rays(camera, o),
      reach{o.filter.radius() * (std::fabs(camera.k_inverse[0]) + std::fabs(camera.k_inverse[1])),
            o.filter.radius() * (std::fabs(camera.k_inverse[2]) + std::fabs(camera.k_inverse[3]))} {}

SubCameraRays::~SubCameraRays() = default;

template <class T>
const AlphaTest* SubCameraRays::see_through(const SceneView<T>& scene) {
    return scene.alpha_masks.face ? &alpha_masks.template emplace<AlphaMasks<T>>(scene, camera, q.data()) : nullptr;
}

template <class T>
std::deque<SubCameraRays> make_sub_camera_rays(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                                               const ImageOptions& o, ThreadTeam& team) {
    std::deque<SubCameraRays> sub_cameras;
    for (const Camera& sub_camera : sub_cameras_for_rays(camera))
        sub_cameras.emplace_back(scene, sub_camera, caster, o, team);
    return sub_cameras;
}

template std::deque<SubCameraRays> make_sub_camera_rays(const SceneView<float>&, const Camera&, const RayCaster&,
                                                        const ImageOptions&, ThreadTeam&);
template std::deque<SubCameraRays> make_sub_camera_rays(const SceneView<double>&, const Camera&, const RayCaster&,
                                                        const ImageOptions&, ThreadTeam&);

}  // namespace edgegrad
