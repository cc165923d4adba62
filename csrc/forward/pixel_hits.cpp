#include "forward/pixel_hits.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <limits>

#include "camera/camera_rays.h"
#include "camera/depth_bound.h"
#include "camera/vertices.h"
#include "contract/record.h"
#include "shading/surface.h"

namespace edgegrad {

namespace {

// The pixels of one row.
template <class T>
class HitRow {
   public:
    HitRow(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, const CameraFrame& frame,
           const ImageOptions& options, const Array<Vec3>& q, const HitBuffers<T>& out, Team& team)
        : scene_(scene),
          camera_(camera),
          caster_(caster),
          options_(options),
          pixel_rays_(camera, options),
          q_(q),
          out_(out),
          team_(team),
          rays_(frame),
          reach_{options.filter.radius() * (std::fabs(camera.k_inverse[0]) + std::fabs(camera.k_inverse[1])),
                 options.filter.radius() * (std::fabs(camera.k_inverse[2]) + std::fabs(camera.k_inverse[3]))} {}

    void find(int y, PixelHits& to) {
        for (int x = 0; x < camera_.width; ++x)
            for (int done = 0; done < options_.spp;) {
                const int n = std::min(options_.spp - done, RayBatch::size - rays_.count);
                pixel_rays_.append(x, y, done, n, rays_);
                part_[parts_++] = {x, n};
                done += n;
                if (rays_.count == RayBatch::size || (x + 1 == camera_.width && done == options_.spp)) cast(y, to);
            }
    }

   private:
    // Samples of a pixel on one face, at one of them.
    struct Group {
        int32_t face;
        int count;
        uint64_t key;
        Vec2 n;
    };

    void cast(int y, PixelHits& to) {
        team_.check();
        rays_.prepare();
        caster_.cast(rays_);
        // A face whose plane holds the eye shows nothing.
        if (std::any_of(rays_.face, rays_.face + rays_.count, [&](int32_t f) { return f >= 0 && !is_known(f); })) {
            rays_.prepare();
            caster_.cast_through(rays_, nullptr, [&](int32_t face) { return !is_unseen(face); });
        }
        int i = 0;
        for (int p = 0; p < parts_; ++p) {
            if (part_[p].x != x_) groups_.clear(), x_ = part_[p].x, samples_ = 0;
            for (const int end = i + part_[p].n; i < end; ++i, ++samples_)
                if (rays_.face[i] >= 0) add(rays_.face[i], rays_.n(i), y);
            if (samples_ == options_.spp) finish(y, to);
        }
        rays_.count = parts_ = 0;
    }

    // The sample with the least random number stands for all. So where one more or one less hits the face, it mostly
    // stays the same, and images of scenes that differ a little do.
    void add(int32_t face, Vec2 n, int y) {
        const uint64_t key = hash(options_.seed, hash(5, uint64_t(y) * camera_.width + x_), samples_);
        auto group = std::find_if(groups_.begin(), groups_.end(), [&](const Group& g) { return g.face == face; });
        if (group == groups_.end()) {
            groups_.push_back({face, 1, key, n});
            return;
        }
        ++group->count;
        if (key < group->key) group->key = key, group->n = n;
    }

    void finish(int y, PixelHits& to) {
        const int64_t pixel = int64_t(y) * camera_.width + x_;
        const Vec2 middle = normalised(camera_, {x_ + 0.5, y + 0.5});
        int hits = 0;
        double farthest = -std::numeric_limits<double>::infinity();
        int32_t first = std::numeric_limits<int32_t>::max(), last = -1;
        for (const Group& g : groups_) {
            const auto corner = corners(g.face);
            const FaceMap map = face_map(camera_, corner.data());
            const Barycentrics b = barycentrics_of_hit(map, g.n);
            to.pixel.push_back(int32_t(pixel)), to.face.push_back(g.face);
            const Vec2 x = bend(camera_, to_pixels(camera_, g.n)).x;
            append(to.b, {b.u, b.v}), append(to.x, {x.x, x.y});
            to.weight.push_back(double(g.count) / options_.spp);
            hits += g.count;
            DepthBound depth;
            depth.set(camera_, corner.data(), map);
            farthest = std::max(farthest, depth.farthest(middle, reach_));
            first = std::min(first, g.face), last = std::max(last, g.face);
            std::atomic_ref<uint8_t> seen(out_.seen[g.face]);
            if (!seen.load(std::memory_order_relaxed))
                seen.store(camera_.side(corner[0], corner[1], corner[2]), std::memory_order_relaxed);
        }
        out_.coverage[pixel] = T(double(hits) / options_.spp);
        out_.depth[pixel] = hits == options_.spp ? rounded_up(farthest) : std::numeric_limits<float>::infinity();
        out_.hit[2 * pixel] = hits ? first : -1, out_.hit[2 * pixel + 1] = last;
        groups_.clear(), x_ = -1;
    }

    std::array<Vec3, 3> corners(int32_t face) const {
        const int32_t* v = scene_.faces + 3 * int64_t(face);
        return {q_[v[0]], q_[v[1]], q_[v[2]]};
    }
    bool is_unseen(int32_t face) const { return camera_.passes_through_eye(corners(face).data()); }
    // Whether a face shows something, kept for those that come again.
    bool is_known(int32_t face) {
        int32_t& known = known_[unsigned(face) % known_.size()];
        if (known != face && !is_unseen(face)) known = face;
        return known == face;
    }

    const SceneView<T>& scene_;
    const Camera& camera_;
    const RayCaster& caster_;
    const ImageOptions& options_;
    const PixelRays pixel_rays_;
    const Array<Vec3>& q_;
    const HitBuffers<T>& out_;
    Team& team_;

    struct Part {
        int x, n;
    };
    static std::array<int32_t, 256> filled() {
        std::array<int32_t, 256> none;
        none.fill(-1);
        return none;
    }
    CameraRays rays_;
    Part part_[RayBatch::size];  // of which pixels the rays are
    int parts_ = 0;
    const Vec2 reach_;  // of the filter around a pixel, in normalised image coordinates
    std::array<int32_t, 256> known_ = filled();
    std::vector<Group> groups_;
    int x_ = -1, samples_ = 0;  // the pixel that they are of, and how many of its samples came
};

}  // namespace

template <class T>
PixelHits find_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                          const ImageOptions& options, int first, int end, Team& team, const HitBuffers<T>& out) {
    const Array<Vec3> q = camera_vertices(camera, scene.verts, scene.n_verts, team);
    const CameraFrame frame(caster, camera);
    std::vector<PixelHits> rows(end - first);
    team.each_with(
        end - first, [&] { return std::make_unique<HitRow<T>>(scene, camera, caster, frame, options, q, out, team); },
        [&](HitRow<T>& row, int64_t k) { row.find(first + int(k), rows[k]); });
    PixelHits all;
    size_t n = 0;
    for (const PixelHits& row : rows) n += row.pixel.size();
    all.pixel.reserve(n), all.face.reserve(n), all.b.reserve(2 * n), all.x.reserve(2 * n), all.weight.reserve(n);
    for (const PixelHits& row : rows) {
        append(all.pixel, row.pixel), append(all.face, row.face), append(all.b, row.b), append(all.x, row.x);
        append(all.weight, row.weight);
    }
    return all;
}

template PixelHits find_pixel_hits(const SceneView<float>&, const Camera&, const RayCaster&, const ImageOptions&, int,
                                   int, Team&, const HitBuffers<float>&);
template PixelHits find_pixel_hits(const SceneView<double>&, const Camera&, const RayCaster&, const ImageOptions&, int,
                                   int, Team&, const HitBuffers<double>&);

}  // namespace edgegrad
