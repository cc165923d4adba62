// Curves that lie behind what the image hit, or next to faces that it did not hit.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/math.h"
#include "estimator/occlusion.h"
#include "estimator/view.h"

namespace edgegrad {

// How few samples a silhouette gets if it lies behind what the image hit (occlusion.h). Never none, for it may be
// visible all the same; a gap may run along it, so that fewer rays than elsewhere find it. What was merely not hit
// counts in full: at the limb of a fine mesh the faces next to a silhouette are a hundredth of a pixel wide and hit by
// chance. Of creases more is known: crease_visibility.h.
constexpr OcclusionHint::Few occluded{.rays = 8, .share = 1.0 / 256, .least = 1.0 / 16};

// The same of a curve next to a face that shows along it wherever the curve does, if no ray hit that face.
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

// In how many pixels a curve is behind all that was hit; 0: not in all of them.
inline int64_t hiding_pixels(const OcclusionHint& occlusion, Vec2 low, Vec2 high, double nearest) {
    const bool small = std::max(high.x - low.x, high.y - low.y) <= 2 * OcclusionHint::reach;
    if (small && occlusion.hides_around(0.5 * (low + high), nearest)) return OcclusionHint::pixels_around;
    return occlusion.hiding_pixels(low, high, nearest);
}

}  // namespace edgegrad
