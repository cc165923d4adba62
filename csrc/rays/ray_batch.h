// Batches rays in packets for Embree.
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <variant>

#include "core/math.h"
#include "rays/embree.h"
#include "rays/ray_frame.h"

namespace edgegrad {

// Holds W rays and their hits in the layout of Embree's RTCRayHit8 and RTCRayHit16, so that a cast copies nothing.
template <int W>
struct alignas(4 * W) RayPacket {
    float origin_x[W] = {}, origin_y[W] = {}, origin_z[W] = {}, t_near[W] = {};
    float direction_x[W] = {}, direction_y[W] = {}, direction_z[W] = {}, time[W] = {};
    float t_far[W] = {};
    unsigned mask[W] = {}, id[W] = {}, flags[W] = {};
    float normal_x[W] = {}, normal_y[W] = {}, normal_z[W] = {}, u[W] = {}, v[W] = {};
    unsigned triangle[W] = {}, geometry[W] = {}, instance[W] = {}, instance_primitive[W] = {};

    static constexpr unsigned nothing = ~0u;  // `geometry` has this before a cast, and if nothing is hit.
    RayPacket();
};

// A ray in world units ends at origin + end · direction.
struct Ray {
    Vec3 origin, direction;
    double end = std::numeric_limits<double>::infinity();
};

// Holds rays that are cast together, and their hits. All rays are made before the first packet is cast: Embree loads
// whole vectors, and one just written piece by piece is not available yet.
class RayBatch {
   public:
    static constexpr int size = 64;
    explicit RayBatch(int width = packet_width());

    int count = 0;

    // Makes ray i. It is cast once, because a cast overwrites it with its hit.
    void set(int i, const RayFrame& frame, const Ray& ray);

    int32_t face[size];    // cast() writes the face that each ray hit, −1 for nothing.
    uint8_t hidden[size];  // cast_occluded() writes whether there is one.

   protected:
    template <int W>
    using Packets = std::array<RayPacket<W>, size / W>;
    std::variant<Packets<8>, Packets<16>> packets_;

   private:
    friend class RayCaster;
    template <int W>
    void read_faces(const Packets<W>& packets);
    void read_faces();
};

}  // namespace edgegrad
