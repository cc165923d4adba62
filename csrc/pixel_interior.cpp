// The yardstick for interior.cpp: the interior term from the samples of the pixels, as other renderers take it.
//
// The rays of the forward pass are cast again and the radiance where they hit is differentiated with the weight A /
// spp. A face that is seen at a grazing angle, or that is smaller than a pixel, is hit by chance.

#include <algorithm>
#include <vector>

#include "interior.h"

namespace edgegrad {

template <int N, class T>
double add_interior_of_pixels(const BackwardView<T>& view, const ForwardOptions& o, const T* adjoint, bool geometry,
                              Destination& to) {
    const int C = N ? N : view.scene.channels, width = view.camera.width;
    const int64_t pixels = int64_t(width) * view.camera.height;
    const PixelRays pixel_rays(view.camera, o);
    double seconds[2] = {0, 0};
    scatter_samples(pixels, o.threads, to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        // Faces in a pixel take turns and come again in the next one: some runs are kept open.
        std::vector<FaceGrad<N, T>> open(32, FaceGrad<N, T>(view, geometry, to, grad));
        std::vector<double> bar(C);
        RayBatch rays(view.frame);
        for (int64_t pixel = first; pixel < last; ++pixel) {
            for (int c = 0; c < C; ++c) bar[c] = double(adjoint[pixel * C + c]) / o.spp;
            for (int done = 0; done < o.spp; done += RayBatch::size) {
                rays.count = 0;
                pixel_rays.append(int(pixel % width), int(pixel / width), done, std::min(o.spp - done, RayBatch::size),
                                  rays);
                rays.prepare();
                view.geometry.caster().cast(rays);
                for (int i = 0; i < rays.count; ++i) {
                    const int32_t face = rays.face[i];
                    if (face < 0) continue;
                    FaceGrad<N, T>& run = open[unsigned(face) % open.size()];
                    if (run.face() != face) run.flush(), run.start(face);
                    run.add(rays.n(i), bar.data());
                }
            }
        }
        for (FaceGrad<N, T>& run : open) run.flush();
    });
    return seconds[0] + seconds[1];
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template double add_interior_of_pixels<N, float>(const BackwardView<float>&, const ForwardOptions&, const float*, bool, Destination&); \
    template double add_interior_of_pixels<N, double>(const BackwardView<double>&, const ForwardOptions&, const double*, bool, Destination&);
EDGEGRAD_INSTANTIATE(0)
EDGEGRAD_INSTANTIATE(1)
EDGEGRAD_INSTANTIATE(3)
EDGEGRAD_INSTANTIATE(4)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
