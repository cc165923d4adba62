// The only door to Embree: opens the library, keeps a ray structure over triangles, casts packets of any
// rays.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <limits>
#include <mutex>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// Opens libembree4 and makes the device, with options of Embree's own. Throws std::runtime_error when it is not there
// or not version 4.
void open_embree(const std::string& path, const std::string& options = "");

// Held by whoever makes, builds or frees a ray structure, so that fork() can wait until nobody does: see before_fork().
extern std::mutex embree_mutex;

// Waits, with embree_mutex held, until Embree's threads sleep after the last build.
void let_embree_sleep();

// Version of the opened library, as 40400 for 4.4.0.
int embree_version();

// Rays in a packet: 16 where the processor's vectors are that wide (AVX-512), else 8.
int packet_width();

// W rays and what they hit, in the layout of Embree's RTCRayHit8 and RTCRayHit16, so that nothing is copied to cast
// them.
template <int W>
struct alignas(4 * W) RayPacket {
    float origin_x[W] = {}, origin_y[W] = {}, origin_z[W] = {}, t_near[W] = {};
    float direction_x[W] = {}, direction_y[W] = {}, direction_z[W] = {}, time[W] = {};
    float t_far[W] = {};
    unsigned mask[W] = {}, id[W] = {}, flags[W] = {};
    float normal_x[W] = {}, normal_y[W] = {}, normal_z[W] = {}, u[W] = {}, v[W] = {};
    unsigned triangle[W] = {}, geometry[W] = {}, instance[W] = {}, instance_primitive[W] = {};

    static constexpr unsigned nothing = ~0u;  // what `geometry` is before a cast, and if nothing is hit
    RayPacket();
};

// The frame in which Embree sees the scene: (p − centre) / unit, where all of it lies within `radius` of the origin.
struct RayFrame {
    Vec3 centre;
    double unit = 1, radius = 1;

    Vec3 position(Vec3 p) const { return (1 / unit) * (p - centre); }

    // Whether floats around o, a position in the frame, would be coarser than the scene.
    bool is_far(Vec3 o) const { return length(o) > 4 * radius; }

    // How far along o + t d a ray may start instead: just before the ball in which everything lies.
    double start(Vec3 o, Vec3 d) const { return -dot(o, d) / dot(d, d) - 2 * radius; }
};

// In world units; it ends at origin + end · direction.
struct Ray {
    Vec3 origin, direction;
    double end = std::numeric_limits<double>::infinity();
};

class RayBatch;

class RayCaster {
   public:
    // The faces (F, 3) must outlive the caster.
    RayCaster(const int32_t* faces, int64_t n_faces, int64_t n_verts);
    ~RayCaster();
    RayCaster(const RayCaster&) = delete;
    RayCaster& operator=(const RayCaster&) = delete;

    // New positions (V, 3), world units. Throws std::invalid_argument if floats cannot hold the faces together, and
    // Interrupted, after which the caster is of no more use.
    void update(const double* verts, Team& team);

    // Of Embree's structure, and of the copies of faces and vertices that it is made from. Resident memory grew by 74.4
    // bytes a face between spheres of 327,680 and 1,310,720 faces, of which 12 are the faces, 18 the vertices and 1
    // says which were seen.
    static int64_t bytes(int64_t faces, int64_t verts) { return faces * (44 + 12) + 36 * verts; }

    // Whether a face has this vertex.
    bool uses(int64_t vertex) const { return used_.empty() || used_[vertex]; }

    const RayFrame& frame() const { return frame_; }

    // The faces that each ray of a batch ignores, if given. Those of a ray ascend if they are more than 16.
    using Ignored = std::span<const int32_t>;

    // The nearest face along each ray.
    void cast(RayBatch& batch, const Ignored* ignored = nullptr) const;

    // The same through what `meets(ray, face)` refuses; `ray` counts those of the batch.
    template <class Meets>
    void cast_through(RayBatch& batch, const Ignored* ignored, const Meets& meets) const;

    // Whether a ray meets any face.
    void cast_occluded(RayBatch& batch, const Ignored* ignored = nullptr) const;

    // The same of the faces that `meets(ray, face)` does not refuse.
    template <class Meets>
    void cast_occluded_through(RayBatch& batch, const Meets& meets) const;

    // Embree's part of cast() alone, to be timed.
    void trace(RayBatch& batch) const { trace(batch, Query::closest, nullptr, nullptr); }

   private:
    enum class Query { closest, any };
    // What `call(data, ray, face)` says of each face that a ray might hit.
    struct Decision {
        bool (*call)(const void* data, int ray, int32_t face);
        const void* data;
    };
    void trace(RayBatch& batch, Query query, const Ignored* ignored, const Decision* meets) const;
    void cast(RayBatch& batch, const Ignored* ignored, const Decision& meets) const;
    void cast_occluded(RayBatch& batch, const Ignored* ignored, const Decision* meets) const;
    template <class Meets>
    static Decision decision(const Meets& meets);

    void set_frame(const double* verts, Team& team);
    void build();

    const int32_t* faces_;
    int64_t n_faces_, n_verts_;
    std::vector<uint8_t> used_;  // (V,) by faces; empty: all are
    // A scene keeps its float precision wherever it lies and whatever its unit.
    RayFrame frame_;
    std::vector<float> positions_;
    void *scene_ = nullptr, *geometry_ = nullptr;
    bool committed_ = false;
    std::atomic<bool> stop_{false};  // asks a build to end
};

// Rays that wait to be cast together, and what they met. They are all made before the first packet is cast: Embree
// loads whole vectors, and one that was just written piece by piece is not there yet.
class RayBatch {
   public:
    static constexpr int size = 64;
    explicit RayBatch(int width = packet_width());

    int count = 0;

    // Makes ray i. It is cast once: a cast leaves what it met in its place.
    void set(int i, const RayFrame& frame, const Ray& ray);

    int32_t face[size];    // after cast(): the one that each ray hit, −1 for nothing
    uint8_t hidden[size];  // after cast_occluded(): whether there is one

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

template <class Meets>
RayCaster::Decision RayCaster::decision(const Meets& meets) {
    return {
        [](const void* data, int ray, int32_t face) -> bool { return (*static_cast<const Meets*>(data))(ray, face); },
        &meets};
}

template <class Meets>
void RayCaster::cast_through(RayBatch& batch, const Ignored* ignored, const Meets& meets) const {
    cast(batch, ignored, decision(meets));
}

template <class Meets>
void RayCaster::cast_occluded_through(RayBatch& batch, const Meets& meets) const {
    const Decision asked = decision(meets);
    cast_occluded(batch, nullptr, &asked);
}

}  // namespace edgegrad
