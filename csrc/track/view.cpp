#include "track/view.h"

#include <cmath>

namespace edgegrad {

TrackCamera::TrackCamera(const Camera& camera)
    : points_(sub_cameras_for_points(camera, 0)),
      rays_(sub_cameras_for_rays(camera)),
      width_(camera.width),
      height_(camera.height),
      perspective_(camera.perspective),
      mirrors_(points_[0].k_det < 0),
      is_single_(!has_cube_faces(camera.lens)) {}

const Camera* TrackCamera::sub_camera(Vec3 q, Vec3& there) const {
    if (is_single_) {
        const Camera& camera = points_[0];
        there = q;
        if (!perspective_) return &camera;
        // The lens folds the image over beyond its disc.
        const double fold = camera.lens_view.disc.fold;
        return q.z > 0 && q.x * q.x + q.y * q.y < fold * fold * q.z * q.z ? &camera : nullptr;
    }
    const Camera* found = nullptr;
    Vec3 first;
    for (const Camera& camera : points_) {
        there = camera.rotation * q;
        if (!(there.z > 0 && std::fabs(there.x) <= there.z && std::fabs(there.y) <= there.z)) continue;
        if (contains(distort(camera, edgegrad::project(camera, there)).x, 0)) return &camera;
        if (!found) found = &camera, first = there;
    }
    there = first;
    return found;
}

std::optional<Vec2> TrackCamera::position(Vec3 q) const {
    Vec3 there;
    const Camera* camera = sub_camera(q, there);
    if (!camera) return {};
    const Vec2 x = distort(*camera, edgegrad::project(*camera, there)).x;
    if (!std::isfinite(x.x + x.y)) return {};
    return x;
}

std::optional<SeenPoint> TrackCamera::project(Vec3 q) const {
    Vec3 there;
    const Camera* camera = sub_camera(q, there);
    if (!camera) return {};
    SeenPoint out{distort(*camera, edgegrad::project(*camera, there)).x, {}, {}};
    IntrinsicsGrad unused;
    project_vjp(*camera, there, {1, 0}, out.dx, unused);
    project_vjp(*camera, there, {0, 1}, out.dy, unused);
    if (!is_single_) {
        out.dx = transposed_times(camera->rotation, out.dx);
        out.dy = transposed_times(camera->rotation, out.dy);
    }
    if (!std::isfinite(out.x.x + out.x.y + dot(out.dx, out.dx) + dot(out.dy, out.dy))) return {};
    return out;
}

std::optional<Ray> TrackCamera::ray(Vec2 x) const {
    for (const Camera& camera : rays_) {
        const Vec2 n = normalised(camera, undistort(camera, x));
        if (!std::isfinite(n.x + n.y)) continue;
        if (!perspective_) return Ray{{n.x, n.y, 0}, {0, 0, 1}};
        const Vec3 d{n.x, n.y, 1};
        return Ray{{}, is_single_ ? d : transposed_times(camera.rotation, d)};
    }
    return {};
}

}  // namespace edgegrad
