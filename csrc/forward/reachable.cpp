#include "forward/reachable.h"

#include <cmath>
#include <vector>

namespace edgegrad {

ReachablePixels::ReachablePixels(const Camera& camera, const RayCaster& caster, const Array<Vec3>& q, double radius,
                                 Team& team)
    : width_(camera.width), margin_(radius + 1) {
    const auto of_block = team.of_blocks(q.size(), [&](int64_t first, int64_t last) {
        Bounds b;
        for (int64_t v = first; v < last; ++v) {
            if (!caster.uses(v)) continue;
            const Vec2 x = project(camera, q[v]);
            const double far = std::max(std::fabs(x.x), std::fabs(x.y));
            if (!(camera.depth_weight(q[v]) > 0) || !std::isfinite(far) || !camera.is_straight()) {
                b = Bounds::everything();
                break;
            }
            b.add(0, x.x), b.add(1, x.y);
            // Of what lies far outside, floats do not say where its sides pass the picture.
            if (far < 1e5) b.add(2, x.x + x.y), b.add(3, x.x - x.y);
            else b.low[2] = b.low[3] = -infinite, b.high[2] = b.high[3] = infinite;
        }
        return b;
    });
    for (const Bounds& b : of_block)
        for (int k = 0; k < 4; ++k) bounds_.add(k, b.low[k]), bounds_.add(k, b.high[k]);
}

ReachablePixels::Range ReachablePixels::row(int y) const {
    const Bounds& b = bounds_;
    const double low = y - margin_, high = y + 1 + margin_;
    if (b.high[1] < low || b.low[1] > high) return {0, 0};
    const double from = std::max({b.low[0], b.low[2] - high, b.low[3] + low});
    const double to = std::min({b.high[0], b.high[2] - low, b.high[3] + high});
    const auto pixel = [&](double x) { return int(std::clamp(x, 0.0, double(width_))); };
    return {pixel(from - margin_), pixel(to + margin_ + 1)};
}

}  // namespace edgegrad
