#include "forward/image_points.h"

#include <algorithm>
#include <atomic>
#include <limits>

#include "camera/face_map.h"
#include "camera/sub_cameras.h"
#include "camera/vertices.h"
#include "rays/alpha_mask.h"
#include "rays/camera_rays.h"

namespace edgegrad {

namespace {

constexpr Vec2 nowhere{std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::quiet_NaN()};

// Returns a point of the image in normalised coordinates of a sub-camera, or NaN where the sub-camera does not show it.
Vec2 through(const Camera& sub_camera, Vec2 x) {
    return sub_camera.may_show(x, 0) ? normalised(sub_camera, undistort(sub_camera, x)) : nowhere;
}

}  // namespace

template <class T>
ImagePointHits hits_at(const SceneView<T>& scene, const Camera& camera, const Geometry& geometry,
                       const ImagePoints& points, ThreadTeam& team) {
    ImagePointHits out;
    out.face.assign(points.size, -1), out.part.assign(points.size, -1), out.b.assign(2 * points.size, 0.0);
    for (const Camera& sub_camera : sub_cameras_for_rays(camera)) {
        const Array<Vec3> q = camera_vertices(sub_camera, scene.verts, scene.n_verts, team);
        const AlphaMasks<T> alpha_masks(scene, sub_camera, q.data());
        const CameraFrame frame(geometry.caster(), sub_camera, scene.alpha_masks.face ? &alpha_masks : nullptr);
        const auto corners = [&](int32_t face) {
            const int32_t* v = scene.faces + 3 * int64_t(face);
            return std::array<Vec3, 3>{q[v[0]], q[v[1]], q[v[2]]};
        };
        // A face whose plane contains the eye is invisible; the image shows what is behind it, too.
        const auto is_seen = [&](int32_t face) { return !sub_camera.passes_through_eye(corners(face).data()); };
        team.parallel_for_blocks(points.size, [&](int64_t, int64_t first, int64_t last) {
            team.check();
            CameraRays rays(frame);
            int64_t index[RayBatch::size];
            const auto cast = [&] {
                rays.prepare();
                frame.cast(rays);
                for (int i = 0; i < rays.count; ++i) {
                    const int32_t face = frame.exact_hit(rays.n(i), rays.face[i], {}, is_seen);
                    if (face < 0) continue;
                    const Barycentrics b = barycentrics_of_hit(face_map(sub_camera, corners(face).data()), rays.n(i));
                    out.face[index[i]] = face;
                    out.part[index[i]] = geometry.parts().of(scene.faces[3 * int64_t(face)]);
                    out.b[2 * index[i]] = b.u, out.b[2 * index[i] + 1] = b.v;
                }
                rays.count = 0;
            };
            for (int64_t k = first; k < last; ++k) {
                const Vec2 n = through(sub_camera, points[k]);
                if (!std::isfinite(n.x + n.y)) continue;
                index[rays.count] = k;
                rays.n_x[rays.count] = n.x, rays.n_y[rays.count] = n.y;
                if (++rays.count == RayBatch::size) cast();
            }
            cast();
        });
    }
    return out;
}

RayRecords rays_at(const Camera& camera, const ImagePoints& points, bool intrinsics, ThreadTeam& team) {
    const std::vector<Camera> sub_cameras = sub_cameras_for_rays(camera);
    std::vector<RayRecords> blocks(ThreadTeam::blocks(points.size));
    team.parallel_for_blocks(points.size, [&](int64_t block, int64_t first, int64_t last) {
        RayRecords& to = blocks[block];
        for (int64_t k = first; k < last; ++k) {
            const Camera* shown_by = &sub_cameras.front();
            Vec2 n = nowhere;
            for (const Camera& sub_camera : sub_cameras)
                if (const Vec2 here = through(sub_camera, points[k]); std::isfinite(here.x + here.y))
                    shown_by = &sub_camera, n = here;
            append_ray(*shown_by, n, to.along, intrinsics ? &to.along_by_k : nullptr, &to.along_by_x);
        }
    });
    RayRecords all;
    for (const RayRecords& block : blocks)
        for (const auto field : {&RayRecords::along, &RayRecords::along_by_x, &RayRecords::along_by_k})
            (all.*field).insert((all.*field).end(), (block.*field).begin(), (block.*field).end());
    return all;
}

template ImagePointHits hits_at(const SceneView<float>&, const Camera&, const Geometry&, const ImagePoints&,
                                ThreadTeam&);
template ImagePointHits hits_at(const SceneView<double>&, const Camera&, const Geometry&, const ImagePoints&,
                                ThreadTeam&);

}  // namespace edgegrad
