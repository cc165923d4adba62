// The interior term from samples of the pixels: rays through them, and the radiance where they hit differentiated with
// the weight A / spp.
//
// For a large triangle with a texture this beats surface samples: its rays are the most coherent there are, and those
// of a pixel and of its neighbours are spread evenly over it (sobol.h). For others it is poor: a triangle that is seen
// at a grazing angle, or is smaller than a pixel, is hit by chance.

#include <algorithm>
#include <vector>

#include "core/channels.h"
#include "core/sobol.h"
#include "interior/face_grad.h"
#include "interior/interior.h"

namespace edgegrad {

template <int N, class T>
void add_pixel_samples(const BackwardView<T>& view, const std::vector<int64_t>& pixels, int spp, uint64_t seed,
                       const uint8_t* faces, bool geometry, Destination& to, double (&seconds)[2]) {
    const int C = N ? N : view.scene.channels, width = view.camera.width;
    const ScrambledSobol sobol(seed);
    view.scatter.add(int64_t(pixels.size()), to, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
        // Faces in a pixel take turns and come again in the next one: some runs are kept open.
        std::vector<FaceGrad<N, T>> open(32, FaceGrad<N, T>(view, geometry, to, grad));
        std::vector<double> bar(C);
        RayBatch rays(view.frame);
        for (int64_t p = first; p < last; ++p) {
            const int64_t pixel = pixels[p];
            const T* A = view.adjoint.of(pixel);
            if (std::all_of(A, A + C, [](T a) { return a == 0; })) continue;
            for (int c = 0; c < C; ++c) bar[c] = double(A[c]) / spp;
            view.team.check();
            const int x = int(pixel % width), y = int(pixel / width);
            const uint64_t place = z_order(x, y) * spp;
            for (int done = 0; done < spp; done += RayBatch::size) {
                rays.count = std::min(spp - done, RayBatch::size);
                sobol.fill(place + done, rays.count, rays.n_x, rays.n_y);
                place_in_pixel(view.camera, view.image.filter, x, y, rays.count, rays.n_x, rays.n_y);
                rays.prepare();
                view.geometry.caster().cast(rays);
                for (int i = 0; i < rays.count; ++i) {
                    const int32_t face = rays.face[i];
                    if (face < 0 || (faces && !faces[face])) continue;
                    FaceGrad<N, T>& run = open[unsigned(face) % open.size()];
                    if (run.face() != face) run.flush(), run.start(face);
                    run.add(rays.n(i), bar.data());
                }
            }
        }
        for (FaceGrad<N, T>& run : open) run.flush();
    });
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template void add_pixel_samples<N, float>(const BackwardView<float>&, const std::vector<int64_t>&, int, uint64_t, const uint8_t*, bool, Destination&, double (&)[2]); \
    template void add_pixel_samples<N, double>(const BackwardView<double>&, const std::vector<int64_t>&, int, uint64_t, const uint8_t*, bool, Destination&, double (&)[2]);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
// clang-format on

}  // namespace edgegrad
