#include "rays/camera_rays.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

CameraFrame::CameraFrame(const RayCaster& caster, const Camera& camera, const AlphaTest* alpha_test)
    : caster_(caster),
      alpha_test_(alpha_test),
      frame_(caster.frame()),
      axis_x_(camera.R_inverse * Vec3{1, 0, 0}),
      axis_y_(camera.R_inverse * Vec3{0, 1, 0}),
      axis_z_(camera.R_inverse * Vec3{0, 0, 1}),
      eye_(frame_.position(camera.R_inverse * -camera.t)),
      perspective_(camera.perspective),
      far_(!camera.perspective || frame_.is_far(eye_)),
      undistorted_(camera.is_undistorted()) {}

void CameraFrame::cast(CameraRays& rays, const RayCaster::Ignored* ignored) const {
    if (alpha_test_) cast_with_alpha_test(rays, ignored, [](int32_t) { return true; });
    else caster_.cast(rays, ignored);
}

double CameraFrame::error(Vec3 p) const {
    // Positions are rounded by their distance from the centre; rays by where they start (see prepare()).
    const double start = frame_.unit * (far_ ? 2 * frame_.radius : length(eye_));
    return 4 * std::numeric_limits<float>::epsilon() * (length(p - frame_.centre) + start);
}

CameraRays::CameraRays(const CameraFrame& frame, int width) : RayBatch(width) { look_through(frame); }

void CameraRays::look_through(const CameraFrame& frame) {
    camera_ = &frame;
    std::visit(
        [&](auto& packets) {
            for (auto& p : packets) {
                std::fill(std::begin(p.origin_x), std::end(p.origin_x), float(frame.eye_.x));
                std::fill(std::begin(p.origin_y), std::end(p.origin_y), float(frame.eye_.y));
                std::fill(std::begin(p.origin_z), std::end(p.origin_z), float(frame.eye_.z));
            }
        },
        packets_);
}

// Always inlined, so it is compiled for each processor of prepare() below.
template <int W>
[[gnu::always_inline]] inline void CameraRays::prepare(Packets<W>& packets) const {
    const CameraFrame& camera = *camera_;
    const Vec3 X = camera.axis_x_, Y = camera.axis_y_, Z = camera.axis_z_;
    for (int k = 0; k < count; k += W) {
        RayPacket<W>& p = packets[k / W];
        const double *x = n_x + k, *y = n_y + k;
        EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) p.t_far[i] = std::numeric_limits<float>::infinity();
        EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) p.geometry[i] = RayPacket<W>::nothing;
        // Where a lens shows nothing, the ray ends before it starts.
        if (!camera.undistorted_)
            for (int i = 0; i < W; ++i)
                if (!std::isfinite(x[i])) p.t_far[i] = -1;
        if (!camera.far_) {
            EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) p.direction_x[i] = float(x[i] * X.x + y[i] * Y.x + Z.x);
            EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) p.direction_y[i] = float(x[i] * X.y + y[i] * Y.y + Z.y);
            EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) p.direction_z[i] = float(x[i] * X.z + y[i] * Y.z + Z.z);
            continue;
        }
        for (int i = 0; i < W; ++i) {
            const Vec3 across = x[i] * X + y[i] * Y;
            Vec3 o = camera.eye_, d = Z;
            if (camera.perspective_) d += across;
            else o += (1 / camera.frame_.unit) * across;
            // Float positions of a far origin would be coarser than the scene. The ray therefore starts just before the
            // scene, computed here in double, and never behind the eye.
            const double start = camera.frame_.start(o, d);
            o += (camera.perspective_ && start < 0 ? 0 : start) * d;
            p.origin_x[i] = float(o.x), p.origin_y[i] = float(o.y), p.origin_z[i] = float(o.z);
            p.direction_x[i] = float(d.x), p.direction_y[i] = float(d.y), p.direction_z[i] = float(d.z);
        }
    }
}

EDGEGRAD_VECTORIZED void CameraRays::prepare() {
    if (auto* wide = std::get_if<Packets<16>>(&packets_)) prepare<16>(*wide);
    else prepare<8>(std::get<Packets<8>>(packets_));
}

}  // namespace edgegrad
