// The only door to Embree: opens the library, keeps a ray structure over triangles, casts packets of rays.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <mutex>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "camera/camera.h"
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

    RayPacket();
};

class RayBatch;
class RayFrame;

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

    // The nearest face along each ray of the batch, where ray i is blind to the faces in rejected[i], if given. Those
    // of a ray ascend if they are more than 16.
    void cast(RayBatch& batch, const std::span<const int32_t>* rejected = nullptr) const;

    // The same through what `meets(face)` refuses.
    template <class Meets>
    void cast_through(RayBatch& batch, const std::span<const int32_t>* rejected, Meets meets) const;

    // What one ray truly meets, where `face` is what the cast found. Embree decides in float, so near its rim a face
    // may be hit that the ray misses: at a silhouette of a fine mesh that is a neighbour which is seen less wide than
    // floats are apart. `meets(face)` decides, in double where that matters; what it refuses is passed through.
    template <class Meets>
    int32_t beyond_float(const RayFrame& frame, Vec2 n, int32_t face, std::span<const int32_t> rejected,
                         Meets meets) const;

   private:
    friend class RayFrame;
    friend double bare_loop(const Camera&, const RayCaster&, const struct ImageOptions&, int, Team&);

    // What `call(data, face)` says of each face that a ray might hit.
    struct Decision {
        bool (*call)(const void* data, int32_t face);
        const void* data;
    };
    void intersect(RayBatch& batch, const std::span<const int32_t>* rejected = nullptr,
                   const Decision* meets = nullptr) const;
    void cast(RayBatch& batch, const std::span<const int32_t>* rejected, const Decision& meets) const;

    void set_frame(const double* verts, Team& team);
    void build();

    const int32_t* faces_;
    int64_t n_faces_, n_verts_;
    std::vector<uint8_t> used_;  // (V,) by faces; empty: all are
    // Embree sees (p − centre) / unit: a scene keeps its float precision wherever it lies and whatever its unit. All
    // lies within `radius` of the origin there.
    Vec3 centre_;
    double unit_ = 1, radius_ = 1;
    std::vector<float> positions_;
    void *scene_ = nullptr, *geometry_ = nullptr;
    bool committed_ = false;
    std::atomic<bool> stop_{false};  // asks a build to end
};

// The rays of one camera as Embree sees them.
class RayFrame {
   public:
    RayFrame(const RayCaster& caster, const Camera& camera);

    // World units by which a ray may miss a point p that it was aimed at: a few roundings of what Embree is given.
    double error(Vec3 p) const;

   private:
    friend class RayBatch;
    Vec3 axis_x_, axis_y_, axis_z_;  // of the camera, in world coordinates times whatever scale they have
    Vec3 eye_, centre_;
    double unit_, radius_;
    bool perspective_, far_;
};

// Rays of a camera that wait to be cast together, by where they go in the image, and the faces that they hit. They are
// all made before the first packet is cast: Embree loads whole vectors, and one that was just written piece by piece is
// not there yet.
class RayBatch {
   public:
    static constexpr int size = 64;
    explicit RayBatch(const RayFrame& frame, int width = packet_width());

    // Normalised image coordinates; the caller fills them from `count` on.
    double n_x[size] = {}, n_y[size] = {};
    int count = 0;

    Vec2 n(int i) const { return {n_x[i], n_y[i]}; }

    // Makes the rays.
    void prepare();

    // The face that each ray hit, −1 for nothing.
    int32_t face[size];

   private:
    friend class RayCaster;
    template <int W>
    using Packets = std::array<RayPacket<W>, size / W>;
    template <int W>
    void prepare(Packets<W>& packets) const;
    template <int W>
    void read_faces(const Packets<W>& packets);
    void read_faces();

    const RayFrame& frame_;
    std::variant<Packets<8>, Packets<16>> packets_;
};

template <class Meets>
void RayCaster::cast_through(RayBatch& batch, const std::span<const int32_t>* rejected, Meets meets) const {
    cast(batch, rejected,
         {[](const void* data, int32_t face) -> bool { return (*static_cast<const Meets*>(data))(face); }, &meets});
}

template <class Meets>
int32_t RayCaster::beyond_float(const RayFrame& frame, Vec2 n, int32_t face, std::span<const int32_t> rejected,
                                Meets meets) const {
    if (face < 0 || meets(face)) return face;
    RayBatch ray(frame);
    ray.n_x[0] = n.x, ray.n_y[0] = n.y, ray.count = 1;
    ray.prepare();
    cast_through(ray, &rejected, meets);
    return ray.face[0];
}

}  // namespace edgegrad
