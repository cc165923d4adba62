#include "forward/reachable.h"

#include <cmath>
#include <vector>

namespace edgegrad {

ReachablePixels::ReachablePixels(const Camera& camera, const RayCaster& caster, const Array<Vec3>& q, double radius,
                                 ThreadTeam& team)
    : width_(camera.width), margin_(radius + 1) {
    const auto of_block = team.map_blocks(q.size(), [&](int64_t first, int64_t last) {
        Bounds b;
        for (int64_t v = first; v < last; ++v) {
            if (!caster.uses(v)) continue;
            const Vec2 x = project(camera, q[v]);
            const double far = std::max(std::fabs(x.x), std::fabs(x.y));
            if (!(camera.depth_weight(q[v]) > 0) || !std::isfinite(far) || has_cube_faces(camera.lens)) {
                b = Bounds::everything();
                break;
            }
            b.add(0, x.x), b.add(1, x.y);
            // For distant vertices, floats do not determine where the octagon's sides pass the image.
            if (far < 1e5) b.add(2, x.x + x.y), b.add(3, x.x - x.y);
            else b.low[2] = b.low[3] = -infinite, b.high[2] = b.high[3] = infinite;
        }
        return b;
    });
    for (const Bounds& b : of_block)
        for (int k = 0; k < 4; ++k) bounds_.add(k, b.low[k]), bounds_.add(k, b.high[k]);
    if (!camera.is_undistorted() && !has_cube_faces(camera.lens)) distort_bounds(camera);
}

std::vector<Vec2> ReachablePixels::polygon(const Bounds& bounds, Vec2 low, Vec2 high) {
    std::vector<Vec2> corners{low, {high.x, low.y}, high, {low.x, high.y}};
    const Vec2 normal[4] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}};
    for (int k = 0; k < 4; ++k)
        for (const double sign : {1.0, -1.0}) {
            const double bound = sign > 0 ? bounds.high[k] : -bounds.low[k];
            const auto outside = [&](Vec2 x) { return sign * (normal[k].x * x.x + normal[k].y * x.y) - bound; };
            std::vector<Vec2> inside;
            for (size_t i = 0; i < corners.size(); ++i) {
                const Vec2 a = corners[i], b = corners[(i + 1) % corners.size()];
                const double at_a = outside(a), at_b = outside(b);
                if (at_a <= 0) inside.push_back(a);
                if ((at_a <= 0) != (at_b <= 0)) inside.push_back(a + (at_a / (at_a - at_b)) * (b - a));
            }
            corners = std::move(inside);
        }
    return corners;
}

// Within its disc, a lens maps the octagon one to one, so the image of its border surrounds its own image.
void ReachablePixels::distort_bounds(const Camera& camera) {
    constexpr int pieces = 64;  // Each side has this many.
    const Vec2 widen{margin_, margin_};
    const std::vector<Vec2> corners = polygon(bounds_, camera.lens_view.low - widen, camera.lens_view.high + widen);
    spans_.assign(camera.height, {});
    for (size_t i = 0; i < corners.size(); ++i) {
        const Vec2 from = corners[i], side = corners[(i + 1) % corners.size()] - from;
        Distorted distorted[2 * pieces + 1];
        for (int j = 0; j <= 2 * pieces; ++j) {
            distorted[j] = distort(camera, from + (0.5 * j / pieces) * side);
            if (!(distorted[j].area_scale > 0)) return spans_.assign(camera.height, {-infinite, infinite});
        }
        for (int j = 0; j < 2 * pieces; j += 2) {
            const Vec2 a = distorted[j].x, b = distorted[j + 2].x;
            // A margin of twice the distance of a piece's middle from its chord contains the piece.
            const double more = margin_ + 2 * length(distorted[j + 1].x - 0.5 * (a + b));
            const auto row = [&](double y) { return int(std::clamp(y, 0.0, double(camera.height))); };
            const Span piece{std::min(a.x, b.x) - more, std::max(a.x, b.x) + more};
            for (int y = row(std::min(a.y, b.y) - more), end = row(std::max(a.y, b.y) + more + 1); y < end; ++y)
                spans_[y].from = std::min(spans_[y].from, piece.from), spans_[y].to = std::max(spans_[y].to, piece.to);
        }
    }
}

ReachablePixels::Range ReachablePixels::row(int y) const {
    const auto pixel = [&](double x) { return int(std::clamp(x, 0.0, double(width_))); };
    if (!spans_.empty()) return {pixel(spans_[y].from), pixel(spans_[y].to + 1)};
    const Bounds& b = bounds_;
    const double low = y - margin_, high = y + 1 + margin_;
    if (b.high[1] < low || b.low[1] > high) return {0, 0};
    const double from = std::max({b.low[0], b.low[2] - high, b.low[3] + low});
    const double to = std::min({b.high[0], b.high[2] - low, b.high[3] + high});
    return {pixel(from - margin_), pixel(to + margin_ + 1)};
}

}  // namespace edgegrad
