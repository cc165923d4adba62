// The only door to Embree: opens the library, keeps a ray structure over triangles, casts packets of eight rays.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "camera.h"

namespace edgegrad {

// Opens libembree4 and makes the device. Throws std::runtime_error when it is not there or not version 4.
void open_embree(const std::string& path);

// Version of the opened library, as 40400 for 4.4.0.
int embree_version();

// Eight rays. What they hit stands in `face`, −1 for nothing. Lanes from `count` on are not cast.
struct RayPacket {
    static constexpr int size = 8;
    alignas(32) float origin_x[size], origin_y[size], origin_z[size];
    alignas(32) float direction_x[size], direction_y[size], direction_z[size];
    int32_t face[size];
    int count = 0;
};

class RayCaster {
   public:
    // The faces (F, 3) must outlive the caster.
    RayCaster(const int32_t* faces, int64_t n_faces, int64_t n_verts);
    ~RayCaster();
    RayCaster(const RayCaster&) = delete;
    RayCaster& operator=(const RayCaster&) = delete;

    // New positions (V, 3), world units.
    void update(const double* verts, int threads);

    // The nearest face along each ray.
    void cast(RayPacket& packet) const;

    // The same, blind to some faces: those in `rejected[lane]`.
    void cast(RayPacket& packet, const std::span<const int32_t>* rejected) const;

   private:
    friend class RayFrame;
    Vec3 detail_centre(const double* verts, int threads) const;

    const int32_t* faces_;
    int64_t n_faces_, n_verts_;
    // Embree sees (p − centre) / radius: a scene keeps its float precision wherever it lies and whatever its unit.
    Vec3 centre_;
    double radius_ = 1;
    std::vector<float> positions_;
    void *scene_ = nullptr, *geometry_ = nullptr;
    bool committed_ = false;
};

// The rays of one camera as Embree sees them.
class RayFrame {
   public:
    RayFrame(const RayCaster& caster, const Camera& camera);

    // Puts a ray, given in camera coordinates, into a lane.
    void set(RayPacket& packet, int lane, const Ray& ray) const {
        Vec3 o = eye_;
        const Vec3 d = rotation_ * ray.direction;
        if (!perspective_) o += inverse_radius_ * (rotation_ * ray.origin);
        if (far_) {
            // Everything lies in the unit ball. Float positions of a far origin would be coarser than the scene, so the
            // ray starts just before the ball, computed here in double; never behind the eye.
            const double start = -dot(o, d) / dot(d, d) - 2;
            o += (perspective_ && start < 0 ? 0 : start) * d;
        }
        packet.origin_x[lane] = float(o.x), packet.origin_y[lane] = float(o.y), packet.origin_z[lane] = float(o.z);
        packet.direction_x[lane] = float(d.x), packet.direction_y[lane] = float(d.y),
        packet.direction_z[lane] = float(d.z);
    }

   private:
    Mat3 rotation_;
    Vec3 eye_;
    double inverse_radius_;
    bool perspective_, far_;
};

}  // namespace edgegrad
