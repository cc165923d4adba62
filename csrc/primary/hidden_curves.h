// This file reduces the samples of curves that lie behind the image's hits, or next to faces without a hit.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"
#include "estimator/occlusion.h"
#include "estimator/view.h"

namespace edgegrad {

// A silhouette behind the hits gets this fraction of its samples (occlusion.h). It is never zero, because the
// silhouette may still be visible: a gap may run along it, which fewer rays than elsewhere find. A face that rays
// merely missed counts in full. At the limb of a fine mesh the faces next to a silhouette are a hundredth of a pixel
// wide and hit by chance. crease_visibility.h knows more of creases.
constexpr OcclusionHint::HiddenFactor occluded_curve{.rays = 8, .share = 1.0 / 256, .least = 1.0 / 16};

// Returns the fraction for a curve next to a face without a hit, if that face is visible wherever the curve is.
template <class T>
double next_to_unhit(const BackwardView<T>& view, int64_t face) {
    if (view.seen[face]) return 1;
    const int32_t* v = view.scene.faces + 3 * face;
    const VertexView& p = view.vertices;
    if (p.outcode[v[0]] | p.outcode[v[1]] | p.outcode[v[2]]) return 1;
    const Vec2 a = p.x[v[0]], b = p.x[v[1]], c = p.x[v[2]];
    const double distorted = distort(view.camera, (1.0 / 3) * (a + b + c)).area_scale;
    return where_unhit(view, face, 0.5 * distorted * std::fabs(wedge(b - a, c - a)));
}

// Returns the number of pixels in which a curve lies behind all hits; 0: it does not in all of them.
inline int64_t hiding_pixels(const OcclusionHint& occlusion, Vec2 low, Vec2 high, double nearest) {
    const bool small = std::max(high.x - low.x, high.y - low.y) <= 2 * OcclusionHint::reach;
    if (small && occlusion.hides_around(0.5 * (low + high), nearest)) return OcclusionHint::pixels_around;
    return occlusion.hiding_pixels(low, high, nearest);
}

}  // namespace edgegrad
