// Exposes internals to tests: any rays, and the radiance of an interior sample on a known face with its derivative.

#include "checks/probe.h"

#include <algorithm>
#include <vector>

#include "accumulate/scatter.h"
#include "accumulate/world.h"
#include "camera/vertices.h"
#include "shading/shade.h"

namespace edgegrad {

template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance) {
    ThreadTeam team(1);
    const Array<Vec3> q = camera_vertices(camera, scene.verts, scene.n_verts, team);
    for (int64_t i = 0; i < n; ++i) {
        const int32_t* v = scene.faces + 3 * int64_t(faces[i]);
        const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
        Barycentrics b;
        barycentrics(face_map(camera, corner),
                     normalised(camera, undistort(camera, {points[2 * i], points[2 * i + 1]})), b);
        shade<0>(scene, faces[i], b, radiance + i * scene.channels);
    }
}

template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const Gradients& grad) {
    ThreadTeam team(1);
    const Array<Vec3> q = camera_vertices(camera, scene.verts, scene.n_verts, team);
    LocalGradients chunk;
    chunk.q.prepare(3, 1), chunk.uvs.prepare(2, 1);
    chunk.colors.prepare(scene.channels, 1), chunk.texels.prepare(scene.channels, 1);
    CornerGrad rows;
    for (int64_t i = 0; i < n; ++i) {
        const int32_t* v = scene.faces + 3 * int64_t(faces[i]);
        const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
        const Vec2 n = normalised(camera, undistort(camera, {points[2 * i], points[2 * i + 1]}));
        const FaceMap map = face_map(camera, corner);
        Barycentrics b;
        barycentrics(map, n, b);
        rows.reset(scene, faces[i]);
        const Barycentrics b_bar =
            shade_vjp<0>(scene, faces[i], b, radiance_bar + i * scene.channels, true, rows, chunk);
        FaceMap map_bar;
        Vec2 n_bar;
        Vec3 corner_bar[3];
        barycentrics_vjp(map, n, b, b_bar, map_bar, n_bar);
        face_map_vjp(camera, corner, map_bar, corner_bar);
        normalised_vjp(camera, n, n_bar, chunk.k);
        for (int j = 0; j < 3; ++j) chunk.q.add(v[j], &corner_bar[j].x);
        rows.add_to(scene, faces[i], {.colors = grad.colors, .uvs = grad.uvs}, chunk);
    }
    Array<double> q_bar = zeros(3 * scene.n_verts, team);
    chunk.q.add_to(q_bar.data(), 0), chunk.colors.add_to(grad.colors, 0);
    chunk.uvs.add_to(grad.uvs, 0), chunk.texels.add_to(grad.texels, 0);
    add_world(camera, scene.verts, q_bar, team, grad);
    for (int i = 0; i < 6; ++i) grad.K[i] += chunk.k.k[i];
}

void cast_rays(const RayCaster& caster, const RayArrays& rays, const IgnoredArrays& ignored, int32_t* face,
               uint8_t* hidden) {
    const auto vec = [](const double* v) { return Vec3{v[0], v[1], v[2]}; };
    for (int64_t first = 0; first < rays.size; first += RayBatch::size) {
        RayBatch closest, any;
        std::vector<RayCaster::Ignored> faces;
        closest.count = any.count = int(std::min<int64_t>(RayBatch::size, rays.size - first));
        for (int i = 0; i < closest.count; ++i) {
            const int64_t k = first + i;
            const Ray ray{vec(rays.origins + 3 * k), vec(rays.directions + 3 * k), rays.ends[k]};
            closest.set(i, caster.frame(), ray), any.set(i, caster.frame(), ray);
            faces.emplace_back(ignored.faces + ignored.first[k], ignored.faces + ignored.first[k + 1]);
        }
        caster.cast(closest, faces.data());
        caster.cast_occluded(any, faces.data());
        std::copy(closest.face, closest.face + closest.count, face + first);
        std::copy(any.hidden, any.hidden + any.count, hidden + first);
    }
}

template void shade_at(const SceneView<float>&, const Camera&, int64_t, const int32_t*, const double*, double*);
template void shade_at(const SceneView<double>&, const Camera&, int64_t, const int32_t*, const double*, double*);
template void shade_at_vjp(const SceneView<float>&, const Camera&, int64_t, const int32_t*, const double*,
                           const double*, const Gradients&);
template void shade_at_vjp(const SceneView<double>&, const Camera&, int64_t, const int32_t*, const double*,
                           const double*, const Gradients&);

}  // namespace edgegrad
