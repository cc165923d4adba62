// Splits a camera into sub-cameras: one image plane, or the faces of a cube around the eye of a panorama or wide
// fisheye. Each has its own frame, and a lens that maps its undistorted image to the one image. Together they see each
// direction once. Rendering and differentiation loop over sub-cameras.
#pragma once

#include <vector>

#include "camera/camera.h"

namespace edgegrad {

// Returns sub-cameras for rays: each pixel position is seen through one of them.
std::vector<Camera> sub_cameras_for_rays(const Camera& camera);

// Returns sub-cameras for points. Each point has one position in the image through one of them, as often as the image,
// widened by `reach` px, shows it. Their rectangles hold no more than the image shows.
std::vector<Camera> sub_cameras_for_points(const Camera& camera, double reach);

// A panorama may reach around this often, either way.
constexpr int most_turns = 4;
bool is_too_wide(const Camera& camera);

// These add the cotangents of K (2, 3) and the coefficients (8,) from those of a sub-camera's intrinsics (null: not
// wanted), and return the tangents.
void add_intrinsics(const Camera& sub_camera, const IntrinsicsGrad& bar, double* K, double* distortion);
IntrinsicsGrad sub_camera_intrinsics(const Camera& sub_camera, const double* K, const double* distortion);

}  // namespace edgegrad
