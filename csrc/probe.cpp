// Radiance and its derivative at points whose face is known: what one interior sample does, laid open for the tests.

#include <vector>

#include "render.h"
#include "shading/shade.h"

namespace edgegrad {

template <class T>
void shade_at(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces, const double* points,
              double* radiance) {
    const std::vector<Vec3> q = camera_vertices(camera, scene.verts, scene.n_verts, 1);
    for (int64_t i = 0; i < n; ++i) {
        const int32_t* v = scene.faces + 3 * int64_t(faces[i]);
        const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
        Barycentrics b;
        intersect(pixel_ray(camera, {points[2 * i], points[2 * i + 1]}), corner, b);
        shade<0>(scene, faces[i], b, radiance + i * scene.channels);
    }
}

template <class T>
void shade_at_vjp(const SceneView<T>& scene, const Camera& camera, int64_t n, const int32_t* faces,
                  const double* points, const double* radiance_bar, const SceneGrad& grad) {
    const std::vector<Vec3> q = camera_vertices(camera, scene.verts, scene.n_verts, 1);
    ChunkGrad chunk;
    chunk.q.set_width(3), chunk.uvs.set_width(2), chunk.colors.set_width(scene.channels),
        chunk.texels.set_width(scene.channels);
    CornerGrad rows;
    for (int64_t i = 0; i < n; ++i) {
        const int32_t *v = scene.faces + 3 * int64_t(faces[i]), *row = scene.corners + 3 * int64_t(faces[i]);
        const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
        const Ray ray = pixel_ray(camera, {points[2 * i], points[2 * i + 1]});
        const int width = is_textured(scene, faces[i]) ? 2 : scene.channels;
        Barycentrics b;
        intersect(ray, corner, b);
        rows.reset(width);
        const Barycentrics b_bar =
            shade_vjp<0>(scene, faces[i], b, radiance_bar + i * scene.channels, true, rows, chunk);
        Vec3 corner_bar[3];
        Ray ray_bar;
        intersect_vjp(ray, corner, b, b_bar, corner_bar, ray_bar);
        pixel_ray_vjp(camera, ray, ray_bar, chunk.k);
        for (int j = 0; j < 3; ++j) {
            chunk.q.add(v[j], &corner_bar[j].x);
            (width == 2 && is_textured(scene, faces[i]) ? chunk.uvs : chunk.colors)
                .add(row[j], rows.value.data() + j * width);
        }
    }
    std::vector<double> q_bar(3 * scene.n_verts, 0.0);
    chunk.q.add_to(q_bar.data(), 0, 1), chunk.colors.add_to(grad.colors, 0, 1);
    chunk.uvs.add_to(grad.uvs, 0, 1), chunk.texels.add_to(grad.texels, 0, 1);
    add_world(camera, scene.verts, q_bar, 1, grad);
    for (int i = 0; i < 6; ++i) grad.K[i] += chunk.k[i];
}

template void shade_at(const SceneView<float>&, const Camera&, int64_t, const int32_t*, const double*, double*);
template void shade_at(const SceneView<double>&, const Camera&, int64_t, const int32_t*, const double*, double*);
template void shade_at_vjp(const SceneView<float>&, const Camera&, int64_t, const int32_t*, const double*,
                           const double*, const SceneGrad&);
template void shade_at_vjp(const SceneView<double>&, const Camera&, int64_t, const int32_t*, const double*,
                           const double*, const SceneGrad&);

}  // namespace edgegrad
