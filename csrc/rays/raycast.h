// Keeps a ray structure over triangles, and casts batches of any rays. This folder is the only door to Embree.
#pragma once

#include <atomic>
#include <cstdint>
#include <span>
#include <vector>

#include "core/parallel.h"
#include "rays/embree.h"
#include "rays/ray_batch.h"
#include "rays/ray_frame.h"

namespace edgegrad {

class RayCaster {
   public:
    // Keeps a reference to the faces (F, 3), which must outlive the caster.
    RayCaster(const int32_t* faces, int64_t n_faces, int64_t n_verts);
    ~RayCaster();
    RayCaster(const RayCaster&) = delete;
    RayCaster& operator=(const RayCaster&) = delete;

    // Sets new positions (V, 3), world units. Throws std::invalid_argument if floats cannot hold the faces together,
    // and Interrupted, after which the caster is unusable.
    void update(const double* verts, ThreadTeam& team);

    // Bounds the memory of Embree's structure, and of the copies of faces and vertices from which it is made. Resident
    // memory grew by 74.4 bytes a face between spheres of 327,680 and 1,310,720 faces. Of these, the faces take 12, the
    // vertices 18, and the marks of seen faces 1.
    static int64_t bytes(int64_t faces, int64_t verts) { return faces * (44 + 12) + 36 * verts; }

    // Returns whether a face has this vertex.
    bool uses(int64_t vertex) const { return used_.empty() || used_[vertex]; }

    const RayFrame& frame() const { return frame_; }

    // Lists the faces that each ray of a batch ignores. A list of more than 16 ascends.
    using Ignored = std::span<const int32_t>;

    // Finds the nearest face along each ray.
    void cast(RayBatch& batch, const Ignored* ignored = nullptr) const;

    // Does the same, and passes through faces that `meets(ray, face)` rejects; `ray` is an index in the batch.
    template <class Meets>
    void cast_with_alpha_test(RayBatch& batch, const Ignored* ignored, const Meets& meets) const;

    // Finds whether each ray hits any face.
    void cast_occluded(RayBatch& batch, const Ignored* ignored = nullptr) const;

    // Does the same, and passes through faces that `meets(ray, face)` rejects.
    template <class Meets>
    void cast_occluded_with_alpha_test(RayBatch& batch, const Meets& meets) const;

    // Runs Embree's part of cast() alone, for timing.
    void trace(RayBatch& batch) const { trace(batch, Query::closest, nullptr, nullptr); }

   private:
    enum class Query { closest, any };
    // Wraps `call(data, ray, face)`, which decides about each face that a ray might hit.
    struct Decision {
        bool (*call)(const void* data, int ray, int32_t face);
        const void* data;
    };
    void trace(RayBatch& batch, Query query, const Ignored* ignored, const Decision* meets) const;
    void cast(RayBatch& batch, const Ignored* ignored, const Decision& meets) const;
    void cast_occluded(RayBatch& batch, const Ignored* ignored, const Decision* meets) const;
    template <class Meets>
    static Decision decision(const Meets& meets);

    void build();

    const int32_t* faces_;
    int64_t n_faces_, n_verts_;
    std::vector<uint8_t> used_;  // (V,) whether faces use a vertex; empty: all are
    // The frame keeps a scene's float precision at any position and in any unit.
    RayFrame frame_;
    std::vector<float> positions_;
    void *scene_ = nullptr, *geometry_ = nullptr;
    bool committed_ = false;
    std::atomic<bool> stop_{false};  // request to end a build
};

template <class Meets>
RayCaster::Decision RayCaster::decision(const Meets& meets) {
    return {
        [](const void* data, int ray, int32_t face) -> bool { return (*static_cast<const Meets*>(data))(ray, face); },
        &meets};
}

template <class Meets>
void RayCaster::cast_with_alpha_test(RayBatch& batch, const Ignored* ignored, const Meets& meets) const {
    cast(batch, ignored, decision(meets));
}

template <class Meets>
void RayCaster::cast_occluded_with_alpha_test(RayBatch& batch, const Meets& meets) const {
    const Decision decide = decision(meets);
    cast_occluded(batch, nullptr, &decide);
}

}  // namespace edgegrad
