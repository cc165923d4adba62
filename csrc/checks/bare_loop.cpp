// The yardstick of the benchmarks: the rays of the forward pass, made beforehand, cast and nothing else.

#include <algorithm>
#include <numeric>
#include <vector>

#include "checks/probe.h"
#include "core/stopwatch.h"

namespace edgegrad {

double bare_loop(const Camera& camera, const RayCaster& caster, const ImageOptions& o, int packet_width,
                 ThreadTeam& team) {
    constexpr int tile = 16;
    const int tiles_x = (camera.width + tile - 1) / tile, tiles_y = (camera.height + tile - 1) / tile;
    const CameraFrame frame(caster, camera, nullptr);
    const PixelRays pixel_rays(camera, o);
    std::vector<double> seconds(int64_t(tiles_x) * tiles_y);
    team.parallel_for_with_state(
        seconds.size(), [] { return std::make_unique<std::vector<CameraRays>>(); },
        [&](std::vector<CameraRays>& batches, int64_t t) {
            const int x0 = int(t % tiles_x) * tile, y0 = int(t / tiles_x) * tile;
            batches.clear();
            for (int y = y0; y < std::min(y0 + tile, camera.height); ++y)
                for (int x = x0; x < std::min(x0 + tile, camera.width); ++x) {
                    for (int done = 0; done < o.spp;) {
                        if (batches.empty() || batches.back().count == RayBatch::size)
                            batches.emplace_back(frame, packet_width);
                        CameraRays& rays = batches.back();
                        const int n = std::min(o.spp - done, RayBatch::size - rays.count);
                        pixel_rays.append(x, y, done, n, rays);
                        done += n;
                    }
                }
            for (CameraRays& rays : batches) rays.prepare();
            Stopwatch watch;
            for (CameraRays& rays : batches) caster.trace(rays);
            seconds[t] = watch.lap();
        });
    return std::accumulate(seconds.begin(), seconds.end(), 0.0) / team.threads();
}

}  // namespace edgegrad
