#include "rays/geometry.h"

#include <algorithm>
#include <cstring>
#include <list>
#include <mutex>

#include "core/openmp_runtime.h"

namespace edgegrad {

Geometry::Geometry(const int32_t* faces, int64_t n_faces, int64_t n_verts)
    : faces_(faces, faces + 3 * n_faces), caster_(faces_.data(), n_faces, n_verts) {}

namespace {

std::mutex mutex;
// The most recently used is first. The list is never destroyed, as threads may render while the process ends.
std::list<std::shared_ptr<Geometry>>& kept = *new std::list<std::shared_ptr<Geometry>>;
constexpr size_t most_kept = 8;

template <class T>
bool same(const std::vector<T>& kept_values, const T* values, int64_t n) {
    return int64_t(kept_values.size()) == n && std::memcmp(kept_values.data(), values, n * sizeof(T)) == 0;
}

}  // namespace

// Handles one request for geometry: it searches the list and extends it, each under the lock.
class KeptGeometry {
   public:
    KeptGeometry(const int32_t* faces, int64_t n_faces, const double* verts, int64_t n_verts, const Spacing& spacing)
        : faces_(faces), verts_(verts), n_faces_(n_faces), n_verts_(n_verts), spacing_(spacing) {}

    std::shared_ptr<const Geometry> acquire(GeometryWanted wanted, ThreadTeam& team, GeometryWork& work) {
        const bool moved = !find(wanted);
        if (moved) {
            work.rays = true;
            if (!geometry_) geometry_ = std::make_shared<Geometry>(faces_, n_faces_, n_verts_);
            geometry_->caster_.update(verts_, team);
            geometry_->verts_.assign(verts_, verts_ + 3 * n_verts_);
            geometry_->spacing_ = spacing_;
        }
        const int32_t* faces = geometry_->faces_.data();
        if (weld_) {
            work.edges = true;
            if (!topology_) topology_ = std::make_unique<Topology>(faces, n_faces_, n_verts_, team);
            topology_->weld(verts_, spacing_, team);
        }
        if (make_parts_) parts_ = std::make_unique<ConnectedParts>(faces, n_faces_, n_verts_, team);
        if (find_intersections_) {
            work.intersections = true;
            const Topology& topology = topology_ ? *topology_ : *geometry_->topology_;
            intersections_ =
                std::make_unique<Intersections>(PlacedFaces{faces, n_faces_, verts_, spacing_, topology}, order_, team);
        }
        keep(moved);
        return geometry_;
    }

   private:
    // Returns whether there is geometry at these positions. If not, takes an unused one out of the list, if any.
    bool find(GeometryWanted wanted) {
        const std::lock_guard lock(mutex);
        auto found = kept.end();
        bool here = false;
        for (auto it = kept.begin(); it != kept.end() && !here; ++it) {
            if (!same((*it)->faces_, faces_, 3 * n_faces_)) continue;
            here = same((*it)->verts_, verts_, 3 * n_verts_) && (*it)->spacing_ == spacing_;
            const bool free = it->use_count() == 1 && (*it)->verts_.size() == size_t(3 * n_verts_);
            if (here || (free && found == kept.end())) found = it;
        }
        if (found != kept.end()) geometry_ = *found;
        if (geometry_ && !here) kept.erase(found), geometry_->welded_ = false;
        weld_ = wanted.topology && !(geometry_ && geometry_->welded_);
        if (geometry_ && !here) geometry_->intersections_.reset();
        find_intersections_ = wanted.intersections && !(geometry_ && geometry_->intersections_);
        if (find_intersections_ && geometry_) order_ = std::move(geometry_->order_);
        make_parts_ = wanted.parts && !(geometry_ && geometry_->parts_);
        // Edges of other positions have no readers. Taking them keeps other threads from welding them at the same time.
        if (weld_ && geometry_) topology_ = std::move(geometry_->topology_);
        return here;
    }

    // Stores the results in the geometry, and that in the list, unless another thread has done so meanwhile.
    void keep(bool moved) {
        const std::lock_guard lock(mutex);
        if (topology_ && !geometry_->welded_) geometry_->topology_ = std::move(topology_), geometry_->welded_ = true;
        if (parts_ && !geometry_->parts_) geometry_->parts_ = std::move(parts_);
        if (intersections_ && !geometry_->intersections_)
            geometry_->intersections_ = std::move(intersections_), geometry_->order_ = std::move(order_);
        const auto equal = [&](const std::shared_ptr<Geometry>& other) {
            return other == geometry_ ||
                   (moved && other->spacing_ == spacing_ && same(other->verts_, verts_, 3 * n_verts_) &&
                    same(other->faces_, faces_, 3 * n_faces_));
        };
        kept.remove_if(equal);
        kept.push_front(geometry_);
        while (kept.size() > most_kept) kept.pop_back();
    }

    const int32_t* const faces_;
    const double* const verts_;
    const int64_t n_faces_, n_verts_;
    const Spacing& spacing_;

    std::shared_ptr<Geometry> geometry_;
    bool weld_ = false, make_parts_ = false, find_intersections_ = false;
    std::unique_ptr<Topology> topology_;
    std::unique_ptr<ConnectedParts> parts_;
    std::unique_ptr<Intersections> intersections_;
    FaceOrder order_;
};

std::shared_ptr<const Geometry> acquire_geometry(const int32_t* faces, int64_t n_faces, const double* verts,
                                                 int64_t n_verts, const Spacing& spacing, GeometryWanted wanted,
                                                 ThreadTeam& team, GeometryWork& work) {
    return KeptGeometry(faces, n_faces, verts, n_verts, spacing).acquire(wanted, team, work);
}

void clear_geometry() {
    const std::lock_guard lock(mutex);
    kept.clear();
}

namespace {

// Counts this thread's open calls of before_fork(), which Python registers again with each import of the package.
thread_local int forks = 0;

}  // namespace

void before_fork() {
    if (forks++) return;
    mutex.lock();
    embree_mutex.lock();
    // The child does not need Embree's threads, because the building thread can do all of the work.
    let_embree_sleep();
    end_waiting_threads();
}

void after_fork() {
    if (--forks) return;
    embree_mutex.unlock();
    mutex.unlock();
}

}  // namespace edgegrad
