// Generates the rays of a camera.
#pragma once

#include <limits>
#include <span>

#include "camera/camera.h"
#include "rays/raycast.h"

namespace edgegrad {

// Tells which faces are transparent where the ray at n hits them (rays/alpha_mask.h).
class AlphaTest {
   public:
    virtual bool shows(int32_t face, Vec2 n) const = 0;

   protected:
    ~AlphaTest() = default;
};

class CameraRays;

// Holds a camera in the frame of a ray structure.
class CameraFrame {
   public:
    // `alpha_test` is null if no face is alpha-tested.
    CameraFrame(const RayCaster& caster, const Camera& camera, const AlphaTest* alpha_test);

    // Finds the nearest face along each ray that exists there and that the ray does not ignore.
    void cast(CameraRays& rays, const RayCaster::Ignored* ignored = nullptr) const;

    // Does the same, and passes through faces that `meets(face)` rejects.
    template <class Meets>
    void cast_with_alpha_test(CameraRays& rays, const RayCaster::Ignored* ignored, Meets meets) const;

    // Returns the world units by which a ray may miss a point p that it aims at: a few roundings of Embree's inputs.
    double error(Vec3 p) const;

    // Returns what one ray truly hits, where `face` is what the cast found. Embree decides in float, so it may hit a
    // face near its border that the ray misses. At a silhouette of a fine mesh, that is a neighbour narrower than the
    // spacing of floats. `meets(face)` decides, in double where that matters; the ray passes through rejected faces.
    template <class Meets>
    int32_t exact_hit(Vec2 n, int32_t face, RayCaster::Ignored ignored, Meets meets) const;

   private:
    friend class CameraRays;
    const RayCaster& caster_;
    const AlphaTest* alpha_test_;
    RayFrame frame_;
    Vec3 axis_x_, axis_y_, axis_z_;  // camera's axes in world coordinates, times any scale
    Vec3 eye_;
    bool perspective_, far_, undistorted_;
};

// Holds rays by their image positions.
class CameraRays : public RayBatch {
   public:
    explicit CameraRays(const CameraFrame& frame, int width = packet_width());

    // Uses this camera from now on.
    void look_through(const CameraFrame& frame);

    // They are normalised image coordinates; the caller fills them from `count` on.
    double n_x[size] = {}, n_y[size] = {};

    Vec2 n(int i) const { return {n_x[i], n_y[i]}; }

    // Makes the rays.
    void prepare();

   private:
    template <int W>
    void prepare(Packets<W>& packets) const;

    const CameraFrame* camera_;
};

template <class Meets>
void CameraFrame::cast_with_alpha_test(CameraRays& rays, const RayCaster::Ignored* ignored, Meets meets) const {
    // The rays of a packet mostly ask for the same face together.
    int32_t latest = -1;
    bool met = false;
    caster_.cast_with_alpha_test(rays, ignored, [&](int ray, int32_t face) {
        if (face != latest) latest = face, met = meets(face);
        return met && (!alpha_test_ || alpha_test_->shows(face, rays.n(ray)));
    });
}

template <class Meets>
int32_t CameraFrame::exact_hit(Vec2 n, int32_t face, RayCaster::Ignored ignored, Meets meets) const {
    if (face < 0 || meets(face)) return face;
    CameraRays ray(*this);
    ray.n_x[0] = n.x, ray.n_y[0] = n.y, ray.count = 1;
    ray.prepare();
    cast_with_alpha_test(ray, &ignored, meets);
    return ray.face[0];
}

}  // namespace edgegrad
