#include "geometry.h"

#include <algorithm>
#include <cstring>
#include <list>
#include <mutex>

namespace edgegrad {

Geometry::Geometry(const int32_t* faces, int64_t n_faces, int64_t n_verts)
    : faces_(faces, faces + 3 * n_faces), caster_(faces_.data(), n_faces, n_verts) {}

namespace {

std::mutex mutex;
// The most recently used first. Never destroyed: another thread may render while the process ends.
std::list<std::shared_ptr<Geometry>>& kept = *new std::list<std::shared_ptr<Geometry>>;
constexpr size_t most_kept = 8;

template <class T>
bool same(const std::vector<T>& kept_values, const T* values, int64_t n) {
    return int64_t(kept_values.size()) == n && std::memcmp(kept_values.data(), values, n * sizeof(T)) == 0;
}

}  // namespace

std::shared_ptr<const Geometry> acquire_geometry(const int32_t* faces, int64_t n_faces, const double* verts,
                                                 int64_t n_verts, double spacing, GeometryWanted wanted, Team& team,
                                                 GeometryWork& work) {
    const std::lock_guard lock(mutex);
    auto found = kept.end();
    bool moved = true;
    for (auto it = kept.begin(); it != kept.end(); ++it) {
        if (!same((*it)->faces_, faces, 3 * n_faces)) continue;
        if (same((*it)->verts_, verts, 3 * n_verts) && (*it)->spacing_ == spacing) {
            found = it, moved = false;
            break;
        }
        // In use only by this list: free to be moved.
        if (found == kept.end() && it->use_count() == 1 && (*it)->verts_.size() == size_t(3 * n_verts)) found = it;
    }
    std::shared_ptr<Geometry> geometry;
    if (found != kept.end()) {
        geometry = *found;
        kept.erase(found);
    } else {
        geometry = std::make_shared<Geometry>(faces, n_faces, n_verts);
    }
    if (moved) {
        work.rays = true;
        geometry->verts_.clear();  // should the update fail, these positions must not be taken for it
        geometry->caster_.update(verts, team);
        geometry->verts_.assign(verts, verts + 3 * n_verts);
        geometry->spacing_ = spacing;
        geometry->welded_ = false;
    }
    if (wanted.topology && !geometry->welded_) {
        work.edges = true;
        if (!geometry->topology_)
            geometry->topology_ = std::make_unique<Topology>(geometry->faces_.data(), n_faces, n_verts);
        geometry->topology_->weld(verts, spacing);
        geometry->welded_ = true;
    }
    if (wanted.parts && !geometry->parts_)
        geometry->parts_ = std::make_unique<Parts>(geometry->faces_.data(), n_faces, n_verts);
    kept.push_front(geometry);
    while (kept.size() > most_kept) kept.pop_back();
    return geometry;
}

void clear_geometry() {
    const std::lock_guard lock(mutex);
    kept.clear();
}

namespace {

// Calls of before_fork() that this thread has open: Python registers them anew when the package is imported again.
thread_local int forks = 0;

}  // namespace

void before_fork() {
    if (forks++) return;
    mutex.lock();
    embree_mutex.lock();
    // Embree's threads are not missed in the child, where the one that builds can do all of the work.
    let_embree_sleep();
    before_fork_of_workers();
}

void after_fork(bool child) {
    if (--forks) return;
    after_fork_of_workers(child);
    embree_mutex.unlock();
    mutex.unlock();
}

}  // namespace edgegrad
