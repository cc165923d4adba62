// What a camera sees through: one image plane, or, for a panorama or a wide fisheye, the sides of a cube around its
// eye. Each is a camera with a frame of its own and a lens that takes its undistorted image to the one image; together
// they see each direction once. Who draws an image or differentiates it goes from sub-camera to sub-camera.
#pragma once

#include <vector>

#include "camera/camera.h"

namespace edgegrad {

// For rays: each pixel position is seen through one of them.
std::vector<Camera> sides_of(const Camera& camera);

// For points: each has one place in the image through one of them, as often as the image, widened by `reach` px, shows
// it. The rectangle of each holds no more than what the image shows.
std::vector<Camera> sub_cameras_of(const Camera& camera, double reach);

// The widest panorama: how often it may reach around, either way.
constexpr int most_turns = 4;
bool is_too_wide(const Camera& camera);

// Cotangents of K (2, 3) and the coefficients (8,) from those of a sub-camera's intrinsics, added; null: not wanted.
// And tangents.
void add_intrinsics(const Camera& sub_camera, const IntrinsicsGrad& bar, double* K, double* distortion);
IntrinsicsGrad sub_camera_intrinsics(const Camera& sub_camera, const double* K, const double* distortion);

}  // namespace edgegrad
