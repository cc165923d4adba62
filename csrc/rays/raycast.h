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
    // The faces (F, 3) must outlive the caster.
    RayCaster(const int32_t* faces, int64_t n_faces, int64_t n_verts);
    ~RayCaster();
    RayCaster(const RayCaster&) = delete;
    RayCaster& operator=(const RayCaster&) = delete;

    // New positions (V, 3), world units. Throws std::invalid_argument if floats cannot hold the faces together, and
    // Interrupted, after which the caster is of no more use.
    void update(const double* verts, ThreadTeam& team);

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
    void cast_with_alpha_test(RayBatch& batch, const Ignored* ignored, const Meets& meets) const;

    // Whether a ray meets any face.
    void cast_occluded(RayBatch& batch, const Ignored* ignored = nullptr) const;

    // The same of the faces that `meets(ray, face)` does not refuse.
    template <class Meets>
    void cast_occluded_with_alpha_test(RayBatch& batch, const Meets& meets) const;

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
    const Decision asked = decision(meets);
    cast_occluded(batch, nullptr, &asked);
}

}  // namespace edgegrad
