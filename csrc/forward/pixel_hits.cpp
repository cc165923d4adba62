#include "forward/pixel_hits.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <limits>

#include "camera/depth_bound.h"
#include "camera/face_map.h"
#include "forward/reachable.h"
#include "forward/sub_camera_rays.h"

namespace edgegrad {

namespace {

// Does what edgegrad/points/footprints.py does, with differences so small that texture coordinates are nearly affine.
Spread spread_at(const Camera& camera, const FaceMap& map, Vec2 n) {
    constexpr double aside = 1.0 / 64;  // px
    const auto difference = [&](Vec2 by_pixel) {
        Barycentrics ahead, behind;
        barycentrics(map, n + aside * by_pixel, ahead), barycentrics(map, n - aside * by_pixel, behind);
        return Barycentrics{(ahead.u - behind.u) / (2 * aside), (ahead.v - behind.v) / (2 * aside)};
    };
    const Vec2 x = pixel_vjp(camera, n, {1, 0}), y = pixel_vjp(camera, n, {0, 1});  // rows of ∂n/∂x
    return {difference({x.x, y.x}), difference({x.y, y.y})};
}

// Finds the hits of one row of pixels.
template <class T>
class HitRow {
   public:
    HitRow(const SceneView<T>& scene, const std::deque<SubCameraRays>& sub_cameras, const ImageOptions& options,
           const PixelChoice& choice, const HitBuffers<T>& out, ThreadTeam& team)
        : scene_(scene),
          sub_cameras_(sub_cameras),
          sub_camera_(&sub_cameras.front()),
          options_(options),
          choice_(choice),
          out_(out),
          team_(team),
          rays_(sub_camera_->frame) {}

    // Finds the hits in pixels first … end − 1 of row y; the others have none.
    void find(int y, int first, int end, std::vector<PixelHit>& to) {
        to.reserve(expected_);
        const int width = sub_camera_->camera.width;
        row_.assign(width, {});
        y_ = y;
        for (const SubCameraRays& sub_camera : sub_cameras_) {
            if (&sub_camera != sub_camera_) look_through(sub_camera);
            for (int x = first; x < end; ++x) {
                if (choice_.only && !choice_.only[int64_t(y) * width + x]) continue;
                if (!sub_camera.camera.may_show({x + 0.5, y + 0.5}, options_.filter.radius())) continue;
                for (int done = 0; done < options_.spp;) {
                    const int n = std::min(options_.spp - done, RayBatch::size - rays_.count);
                    sub_camera.pixel_rays.append(x, y, done, n, rays_);
                    runs_[n_runs_++] = {x, n};
                    done += n;
                    if (rays_.count == RayBatch::size) cast(to);
                }
            }
            cast(to);
        }
        expected_ = to.size() + to.size() / 8;
        if (choice_.only) return;
        for (int x = 0; x < width; ++x) {
            const int64_t pixel = int64_t(y) * width + x;
            const Pixel& p = row_[x];
            const bool whole = p.hits == options_.spp;
            out_.coverage[pixel] = T(double(p.hits) / options_.spp);
            out_.depth[pixel] = whole ? rounded_up(p.farthest) : std::numeric_limits<float>::infinity();
            out_.hit[2 * pixel] = p.hits ? p.first : -1, out_.hit[2 * pixel + 1] = p.last;
        }
    }

   private:
    struct KeyedSample {
        uint64_t key;
        Vec2 n;
    };
    // Collects a pixel's samples on one face, and some of them: those with the least keys, as a heap.
    struct Group {
        int32_t face;
        int count;
        std::vector<KeyedSample> drawn;
    };
    static bool is_less(const KeyedSample& a, const KeyedSample& b) { return a.key < b.key; }
    // Holds what pixels on one face share. Some faces are kept, because they recur in the next pixel.
    struct KeptFace {
        int32_t face = -1;
        bool edge_on = false;
        FaceMap map;
        DepthBound depth;
    };
    static constexpr unsigned n_kept = 64;
    struct Pixel {
        int hits = 0;
        double farthest = -std::numeric_limits<double>::infinity();
        int32_t first = std::numeric_limits<int32_t>::max(), last = -1;
    };

    void look_through(const SubCameraRays& sub_camera) {
        sub_camera_ = &sub_camera, rays_.look_through(sub_camera.frame);
        for (KeptFace& kept : kept_) kept.face = -1;
    }

    void cast(std::vector<PixelHit>& to) {
        team_.check();
        rays_.prepare();
        sub_camera_->frame.cast(rays_);
        int i = 0;
        for (int p = 0; p < n_runs_; ++p) {
            if (runs_[p].x != x_) begin(runs_[p].x);
            const int end = i + runs_[p].n;
            for (int k = i; k < end; ++k) {
                if (rays_.face[k] < 0) continue;
                // A face whose plane contains the eye shows nothing.
                if (kept(rays_.face[k]).edge_on) [[unlikely]] {
                    rays_.prepare();
                    sub_camera_->frame.cast_with_alpha_test(rays_, nullptr,
                                                            [&](int32_t face) { return !kept(face).edge_on; });
                    if (rays_.face[k] < 0) continue;
                }
                add(rays_.face[k], samples_ + k - i, rays_.n(k));
            }
            samples_ += runs_[p].n, i = end;
            if (samples_ == options_.spp) finish(to);
        }
        rays_.count = n_runs_ = 0;
    }

    void begin(int x) {
        const int stream = choice_.only ? 6 : 5;
        x_ = x, count_ = samples_ = 0;
        key_ = Hash(options_.seed, hash(stream, uint64_t(y_) * sub_camera_->camera.width + x));
    }

    // Adds a sample. The samples with the least random numbers represent all. They mostly stay the same if one sample
    // more or less hits the face, and so do images of slightly different scenes.
    void add(int32_t face, int sample, Vec2 n) {
        int g = 0;
        while (g < count_ && groups_[g].face != face) ++g;
        if (g == count_) {
            if (size_t(count_++) == groups_.size()) groups_.emplace_back();
            groups_[g].face = face, groups_[g].count = 0, groups_[g].drawn.clear();
        }
        ++groups_[g].count;
        const uint64_t key = key_(sample);
        std::vector<KeyedSample>& drawn = groups_[g].drawn;
        if (int(drawn.size()) == choice_.most) {
            if (drawn.front().key <= key) return;
            std::pop_heap(drawn.begin(), drawn.end(), is_less);
            drawn.pop_back();
        }
        drawn.push_back({key, n});
        std::push_heap(drawn.begin(), drawn.end(), is_less);
    }

    // Appends the hits of a pixel through this sub-camera.
    void finish(std::vector<PixelHit>& to) {
        const Camera& camera = sub_camera_->camera;
        const Vec2 middle = normalised(camera, {x_ + 0.5, y_ + 0.5});
        Pixel& pixel = row_[x_];
        for (int i = 0; i < count_; ++i) {
            const Group& g = groups_[i];
            const KeptFace& face = kept(g.face);
            for (const KeyedSample& drawn : g.drawn) {
                const Barycentrics b = barycentrics_of_hit(face.map, drawn.n);
                const Vec2 x = distort(camera, to_pixels(camera, drawn.n)).x;
                const double weight = double(g.count) / (double(options_.spp) * g.drawn.size());
                const Spread spread = choice_.spread ? spread_at(camera, face.map, drawn.n) : Spread();
                to.push_back({int32_t(int64_t(y_) * camera.width + x_), g.face, b, x, weight, spread});
            }
            pixel.hits += g.count;
            pixel.farthest = std::max(pixel.farthest, face.depth.farthest(middle, sub_camera_->reach));
            pixel.first = std::min(pixel.first, g.face), pixel.last = std::max(pixel.last, g.face);
        }
        x_ = -1;
    }

    const KeptFace& kept(int32_t face) {
        KeptFace& found = kept_[unsigned(face) % n_kept];
        if (found.face != face) keep(found, face);
        return found;
    }
    void keep(KeptFace& kept, int32_t face) {
        const Camera& camera = sub_camera_->camera;
        const int32_t* v = scene_.faces + 3 * int64_t(face);
        const Vec3 corner[3] = {sub_camera_->q[v[0]], sub_camera_->q[v[1]], sub_camera_->q[v[2]]};
        kept.face = face;
        kept.edge_on = camera.passes_through_eye(corner);
        if (kept.edge_on) return;
        kept.map = face_map(camera, corner);
        kept.depth.set(camera, corner, kept.map);
        std::atomic_ref<uint8_t> seen(out_.seen[face]);
        if (!seen.load(std::memory_order_relaxed))
            seen.store(camera.side(corner[0], corner[1], corner[2]), std::memory_order_relaxed);
    }

    const SceneView<T>& scene_;
    const std::deque<SubCameraRays>& sub_cameras_;
    const SubCameraRays* sub_camera_;  // The rays pass through this sub-camera.
    const ImageOptions& options_;
    const PixelChoice& choice_;
    const HitBuffers<T>& out_;
    ThreadTeam& team_;

    struct PixelRun {
        int x, n;
    };
    CameraRays rays_;
    PixelRun runs_[RayBatch::size];  // map rays to pixels
    int n_runs_ = 0;
    std::vector<Pixel> row_;
    int y_ = 0;
    size_t expected_ = 0;  // estimate of the hits in the next row
    KeptFace kept_[n_kept];
    std::vector<Group> groups_;
    int count_ = 0;             // number of groups in use
    int x_ = -1, samples_ = 0;  // current pixel, and the number of its samples so far
    Hash key_{0, 0};            // of the pixel's samples
};

// Keeps the hits of all rows.
class KeepRows : public RowVisitor {
   public:
    KeepRows(std::vector<std::vector<PixelHit>>& rows, int first) : rows_(rows), first_(first) {}
    void visit(int y, std::vector<PixelHit>& hits) override { rows_[y - first_] = std::move(hits); }

   private:
    std::vector<std::vector<PixelHit>>& rows_;
    int first_;
};

}  // namespace

template <class T>
void visit_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                      const ImageOptions& options, const PixelChoice& choice, ThreadTeam& team,
                      const HitBuffers<T>& out, const MakeVisitor& make) {
    const std::deque<SubCameraRays> sub_cameras = make_sub_camera_rays(scene, camera, caster, options, team);
    const int width = camera.width, unit = pixels_of_batches(options.spp);
    const ReachablePixels reachable(sub_cameras.front().camera, caster, sub_cameras.front().q,
                                    options.filter.radius() - 0.5, team);
    struct ThreadState {
        HitRow<T> row;
        std::unique_ptr<RowVisitor> visitor;
        std::vector<PixelHit> hits;
    };
    team.parallel_for_with_state(
        choice.end - choice.first,
        [&] {
            return std::unique_ptr<ThreadState>(
                new ThreadState{HitRow<T>(scene, sub_cameras, options, choice, out, team), make(), {}});
        },
        [&](ThreadState& state, int64_t k) {
            const int y = choice.first + int(k);
            const auto [first, end] = reachable.row(y);
            const int from = first / unit * unit;
            state.hits.clear();
            state.row.find(y, from, std::min(width, from + (std::max(end - from, 0) + unit - 1) / unit * unit),
                           state.hits);
            state.visitor->visit(y, state.hits);
        });
}

template <class T>
PixelHits find_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                          const ImageOptions& options, const PixelChoice& choice, ThreadTeam& team,
                          const HitBuffers<T>& out) {
    std::vector<std::vector<PixelHit>> rows(choice.end - choice.first);
    visit_pixel_hits(scene, camera, caster, options, choice, team, out,
                     [&] { return std::make_unique<KeepRows>(rows, choice.first); });
    std::vector<int64_t> first_of{0};
    for (const std::vector<PixelHit>& row : rows) first_of.push_back(first_of.back() + int64_t(row.size()));
    PixelHits all(first_of.back());
    team.parallel_for(int64_t(rows.size()), [&](int64_t k) {
        int64_t i = first_of[k];
        for (const PixelHit& hit : rows[k]) {
            all.pixel[i] = hit.pixel, all.face[i] = hit.face, all.weight[i] = hit.weight;
            all.b[2 * i] = hit.b.u, all.b[2 * i + 1] = hit.b.v, all.x[2 * i] = hit.x.x, all.x[2 * i + 1] = hit.x.y;
            ++i;
        }
    });
    return all;
}

template void visit_pixel_hits(const SceneView<float>&, const Camera&, const RayCaster&, const ImageOptions&,
                               const PixelChoice&, ThreadTeam&, const HitBuffers<float>&, const MakeVisitor&);
template void visit_pixel_hits(const SceneView<double>&, const Camera&, const RayCaster&, const ImageOptions&,
                               const PixelChoice&, ThreadTeam&, const HitBuffers<double>&, const MakeVisitor&);
template PixelHits find_pixel_hits(const SceneView<float>&, const Camera&, const RayCaster&, const ImageOptions&,
                                   const PixelChoice&, ThreadTeam&, const HitBuffers<float>&);
template PixelHits find_pixel_hits(const SceneView<double>&, const Camera&, const RayCaster&, const ImageOptions&,
                                   const PixelChoice&, ThreadTeam&, const HitBuffers<double>&);

}  // namespace edgegrad
