// The pixel loop. The samples of a pixel are drawn in proportion to the filter and cast together, eight a packet.

#include <vector>

#include "render.h"
#include "sampler.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

template <int N, class T>
void render_pixels(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, const ForwardOptions& o,
                   const std::vector<Vec3>& q, T* image, T* coverage) {
    const int C = N ? N : scene.channels, tile = 16;
    const int tiles_x = (camera.width + tile - 1) / tile, tiles_y = (camera.height + tile - 1) / tile;
    const RayFrame frame(caster, camera);

#pragma omp parallel num_threads(o.threads)
    {
        std::vector<double> sum(C), radiance(C);
        RayPacket packet{};
        Ray rays[RayPacket::size];
#pragma omp for schedule(dynamic, 1)
        for (int t = 0; t < tiles_x * tiles_y; ++t) {
            const int x0 = t % tiles_x * tile, y0 = t / tiles_x * tile;
            for (int y = y0; y < std::min(y0 + tile, camera.height); ++y)
                for (int x = x0; x < std::min(x0 + tile, camera.width); ++x) {
                    const int64_t pixel = int64_t(y) * camera.width + x;
                    const ShiftedLattice lattice(hash(o.seed, uint64_t(pixel)), o.spp);
                    std::fill(sum.begin(), sum.end(), 0.0);
                    int hits = 0;
                    for (int first = 0; first < o.spp; first += RayPacket::size) {
                        packet.count = std::min(RayPacket::size, o.spp - first);
                        for (int i = 0; i < packet.count; ++i) {
                            const Vec2 u = lattice(first + i);
                            rays[i] =
                                pixel_ray(camera, {x + 0.5 + o.filter.sample(u.x), y + 0.5 + o.filter.sample(u.y)});
                            frame.set(packet, i, rays[i]);
                        }
                        caster.cast(packet);
                        for (int i = 0; i < packet.count; ++i) {
                            const int64_t face = packet.face[i];
                            if (face < 0) continue;
                            ++hits;
                            const int32_t* v = scene.faces + 3 * face;
                            const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
                            Barycentrics b;
                            if (!intersect(rays[i], corner, b)) b = {1.0 / 3, 1.0 / 3};  // edge-on: any point will do
                            shade<N>(scene, face, inside(b), radiance.data());
                            for (int c = 0; c < C; ++c) sum[c] += radiance[c];
                        }
                    }
                    const double share = double(hits) / o.spp;
                    const T* behind = scene.background_at(pixel);
                    for (int c = 0; c < C; ++c) image[pixel * C + c] = T(sum[c] / o.spp + (1 - share) * behind[c]);
                    coverage[pixel] = T(share);
                }
        }
    }
}

}  // namespace

template <class T>
void render_forward(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, const ForwardOptions& o,
                    T* image, T* coverage) {
    const std::vector<Vec3> q = camera_vertices(camera, scene.verts, scene.n_verts, o.threads);
    dispatch_channels(scene.channels, [&]<int N>() { render_pixels<N>(scene, camera, caster, o, q, image, coverage); });
}

template void render_forward(const SceneView<float>&, const Camera&, const RayCaster&, const ForwardOptions&, float*,
                             float*);
template void render_forward(const SceneView<double>&, const Camera&, const RayCaster&, const ForwardOptions&, double*,
                             double*);

}  // namespace edgegrad
