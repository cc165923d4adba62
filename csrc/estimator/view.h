// This file holds what all terms of the backward pass share, and the tests of faces in double precision.
#pragma once

#include <algorithm>
#include <array>

#include "accumulate/scatter.h"
#include "camera/face_map.h"
#include "camera/vertices.h"
#include "core/sobol.h"
#include "estimator/gradient_input.h"
#include "estimator/image_hits.h"
#include "estimator/occlusion.h"
#include "film/importance.h"
#include "rays/alpha_mask.h"
#include "rays/camera_rays.h"

namespace edgegrad {

// BackwardView holds what all terms share for one sub-camera.
template <class T>
struct BackwardView {
    const SceneView<T>& scene;
    const Camera& camera;
    const Geometry& geometry;
    const ViewVolume& volume;
    const VertexView& vertices;
    const FilteredAdjoint<T>& adjoint;
    const Importance& importance;
    const ImageOptions& image;  // options of the forward image
    const GradientOptions& options;
    ThreadTeam& team;
    Scatter& scatter;
    const CameraFrame& frame;
    const AlphaTest* alpha_masks;  // null if no face is alpha-tested
    const uint8_t* transparent;    // BackwardInput::transparent faces
    const OcclusionHint& occlusion;
    const ImageHits* hits;           // null if no term needs them
    const uint8_t* detailed;         // (F,), or null: see BackwardInput
    const uint8_t* seen;             // (F,): 0, or the side from which the forward pass hit the face
    const int32_t* hit;              // (H, W, 2): first and last face hit in each pixel
    const Array<T>& vertex_adjoint;  // (V, C): Ã at the vertices of hit faces (vertex_image.h)
    double curve_offset;             // px of the undistorted image, see curve_offset_of()

    // Returns the index of the pixel that contains x.
    int64_t pixel(Vec2 x) const {
        const auto index = [](double x, int size) { return int64_t(std::clamp(std::floor(x), 0.0, size - 1.0)); };
        return index(x.y, camera.height) * camera.width + index(x.x, camera.width);
    }
};

template <class T>
std::array<Vec3, 3> corners_of(const BackwardView<T>& view, int64_t face) {
    const int32_t* v = view.scene.faces + 3 * face;
    const auto& q = view.vertices.q;
    return {q[v[0]], q[v[1]], q[v[2]]};
}

// Returns whether the filter of a pixel reaches y, in camera coordinates, and this sub-camera is responsible for it.
template <class T>
bool is_in_view(const BackwardView<T>& view, Vec3 y) {
    return view.camera.depth_weight(y) > 0 && view.volume.outcode(y) == 0;
}

template <class T>
uint8_t side_of(const BackwardView<T>& view, int64_t face) {
    const auto q = corners_of(view, face);
    return view.camera.side(q[0], q[1], q[2]);
}

// Returns the cell of a vertex among 256 × 256 cells of the image on the Z-order curve; the last one if out of view.
template <class T>
uint16_t cell_of(const BackwardView<T>& view, int32_t vertex) {
    if (view.vertices.outcode[vertex]) return UINT16_MAX;
    const double per_pixel = 256.0 / std::max(view.camera.width, view.camera.height);
    const auto index = [&](double x) { return uint32_t(std::clamp(x * per_pixel, 0.0, 255.0)); };
    const Vec2 x = view.vertices.x[vertex];
    return uint16_t(z_order(index(x.x), index(x.y)));
}

// Returns the factor on the sample density of a face with `area` px² in view, and of curves next to it. It is small
// where rays of the image should have hit the face and none did, because it is most likely occluded. It is at least an
// eighth: a visible strip may be too narrow for rays to find.
template <class T>
double where_unhit(const BackwardView<T>& view, int64_t face, double area) {
    constexpr OcclusionHint::HiddenFactor unhit{.rays = 16, .share = 0, .least = 1.0 / 8};
    return view.seen[face] || view.transparent ? 1 : view.occlusion.factor(unhit, area, view.image.spp);
}

// Rays err by at most this, px: beyond it the image shows rounding, not faces. Curves so near to a silhouette are
// decided with it in double precision (coincident_segments.h). Samples keep so far from a crease's end at one.
constexpr double float_reach = 0.01;

// curve_offset_of() returns how far off a curve the surfaces on either side are evaluated, px of the undistorted image.
//
// The light may be at the eye, or in a plane through the eye and an edge. The edge's shadow boundary then lies on its
// silhouette in the image. Two estimators must then agree on what lies between the two curves. The silhouette tests
// whether the surface behind it is lit. The shadow boundary tests whether the camera sees it. Their sum is
//
//     [L_edge − L_lit] v_silhouette                                      if the shadow is hidden,
//     [L_edge − L_dark] v_silhouette + [L_dark − L_lit] v_shadow         if it is visible,
//
// which are equal for motions that both curves share. Both therefore evaluate at the same distance from their curve: a
// silhouette on its outer side, a shadow boundary on its dark side. A shadow that shows less than that distance counts
// as hidden. The distance exceeds the error of Embree's rays, because a ray along the border of a face may or may not
// meet it in single precision.
constexpr double least_curve_offset = 1e-5;   // px; coincident curves touch by less
constexpr double curve_offset_in_errors = 4;  // in units of the largest error of float rays at a vertex in view
inline double curve_offset_of(const Camera& camera, const CameraFrame& frame, const VertexView& vertices,
                              ThreadTeam& team) {
    const auto worst = team.map_blocks(vertices.q.size(), [&](int64_t first, int64_t last) {
        double most = 0;
        for (int64_t v = first; v < last; ++v)
            if (!vertices.outcode[v])
                most = std::max(most, frame.error(camera.R_inverse * (vertices.q[v] - camera.t)) /
                                          camera.pixel_at_depth(vertices.q[v].z));
        return most;
    });
    const double most = worst.empty() ? 0 : *std::max_element(worst.begin(), worst.end());
    return std::clamp(curve_offset_in_errors * most, least_curve_offset, float_reach);
}

// Returns whether alpha masks leave the face opaque where the ray at n meets it.
template <class T>
bool is_there(const BackwardView<T>& view, int64_t face, Vec2 n) {
    return !view.alpha_masks || view.alpha_masks->shows(int32_t(face), n);
}

// Returns whether the ray at n meets a face, decided in double precision.
template <class T>
bool meets(const BackwardView<T>& view, int64_t face, Vec2 n) {
    const auto corner = corners_of(view, face);
    return covers(face_map(view.camera, corner.data()), n) && !view.camera.passes_through_eye(corner.data()) &&
           is_there(view, face, n);
}

// Returns the depth at which the ray at n meets a face.
template <class T>
double depth_of(const BackwardView<T>& view, int64_t face, Vec2 n) {
    const auto corner = corners_of(view, face);
    const Barycentrics b = barycentrics_of_hit(face_map(view.camera, corner.data()), n);
    return b[0] * corner[0].z + b[1] * corner[1].z + b[2] * corner[2].z;
}

// Returns whether a face lies before a depth by several times its size. If a ray misses such a face after all, single
// precision has mostly confused it with a neighbour. A ray that ignores the face might miss that neighbour too. Single
// precision therefore decides, as for the image.
template <class T>
bool lies_far_before(const BackwardView<T>& view, int64_t face, double depth) {
    const auto q = corners_of(view, face);
    const double gap = depth - std::max({q[0].z, q[1].z, q[2].z});
    const Vec3 a = q[1] - q[0], b = q[2] - q[1], c = q[0] - q[2];
    return gap > 0 && gap * gap > 16 * std::max({dot(a, a), dot(b, b), dot(c, c)});
}

}  // namespace edgegrad
