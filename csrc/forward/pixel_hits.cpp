#include "forward/pixel_hits.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <limits>

#include "camera/depth_bound.h"
#include "contract/record.h"
#include "forward/side.h"
#include "shading/surface.h"

namespace edgegrad {

namespace {

// The pixels of one row.
template <class T>
class HitRow {
   public:
    HitRow(const SceneView<T>& scene, const std::deque<Side>& sides, const ImageOptions& options,
           const PixelChoice& choice, const HitBuffers<T>& out, Team& team)
        : scene_(scene),
          sides_(sides),
          side_(&sides.front()),
          options_(options),
          choice_(choice),
          out_(out),
          team_(team),
          rays_(side_->frame) {}

    void find(int y, PixelHits& to) {
        const int width = side_->camera.width;
        row_.assign(width, {});
        y_ = y;
        for (const Side& side : sides_) {
            if (&side != side_) side_ = &side, rays_.look_through(side.frame), known_ = filled();
            for (int x = 0; x < width; ++x) {
                if (choice_.only && !choice_.only[int64_t(y) * width + x]) continue;
                if (!side.camera.may_show({x + 0.5, y + 0.5}, options_.filter.radius())) continue;
                for (int done = 0; done < options_.spp;) {
                    const int n = std::min(options_.spp - done, RayBatch::size - rays_.count);
                    side.pixel_rays.append(x, y, done, n, rays_);
                    part_[parts_++] = {x, n};
                    done += n;
                    if (rays_.count == RayBatch::size) cast(to);
                }
            }
            cast(to);
        }
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
    struct Drawn {
        uint64_t key;
        Vec2 n;
    };
    // Samples of a pixel on one face, at some of them: those with the least keys, a heap.
    struct Group {
        int32_t face;
        int count;
        std::vector<Drawn> drawn;
    };
    static bool is_less(const Drawn& a, const Drawn& b) { return a.key < b.key; }
    struct Pixel {
        int hits = 0;
        double farthest = -std::numeric_limits<double>::infinity();
        int32_t first = std::numeric_limits<int32_t>::max(), last = -1;
    };

    void cast(PixelHits& to) {
        team_.check();
        rays_.prepare();
        side_->frame.cast(rays_);
        // A face whose plane holds the eye shows nothing.
        if (std::any_of(rays_.face, rays_.face + rays_.count, [&](int32_t f) { return f >= 0 && !is_known(f); })) {
            rays_.prepare();
            side_->frame.cast_through(rays_, nullptr, [&](int32_t face) { return !is_unseen(face); });
        }
        int i = 0;
        for (int p = 0; p < parts_; ++p) {
            if (part_[p].x != x_) count_ = 0, x_ = part_[p].x, samples_ = 0;
            for (const int end = i + part_[p].n; i < end; ++i, ++samples_)
                if (rays_.face[i] >= 0) add(rays_.face[i], rays_.n(i));
            if (samples_ == options_.spp) finish(to);
        }
        rays_.count = parts_ = 0;
    }

    // The samples with the least random numbers stand for all. So where one more or one less hits the face, they mostly
    // stay the same, and images of scenes that differ a little do.
    void add(int32_t face, Vec2 n) {
        const int stream = choice_.only ? 6 : 5;
        const uint64_t key = hash(options_.seed, hash(stream, uint64_t(y_) * side_->camera.width + x_), samples_);
        const auto end = groups_.begin() + count_;
        auto group = std::find_if(groups_.begin(), end, [&](const Group& g) { return g.face == face; });
        if (group == end) {
            if (end == groups_.end()) groups_.emplace_back();
            group = groups_.begin() + count_++;
            group->face = face, group->count = 0, group->drawn.clear();
        }
        ++group->count;
        std::vector<Drawn>& drawn = group->drawn;
        if (int(drawn.size()) == choice_.most) {
            if (drawn.front().key <= key) return;
            std::pop_heap(drawn.begin(), drawn.end(), is_less);
            drawn.pop_back();
        }
        drawn.push_back({key, n});
        std::push_heap(drawn.begin(), drawn.end(), is_less);
    }

    // Hands over what a pixel shows through this side.
    void finish(PixelHits& to) {
        const Camera& camera = side_->camera;
        const Vec2 middle = normalised(camera, {x_ + 0.5, y_ + 0.5});
        Pixel& pixel = row_[x_];
        for (int i = 0; i < count_; ++i) {
            const Group& g = groups_[i];
            const auto corner = corners(g.face);
            const FaceMap map = face_map(camera, corner.data());
            for (const Drawn& drawn : g.drawn) {
                const Barycentrics b = barycentrics_of_hit(map, drawn.n);
                const Vec2 x = bend(camera, to_pixels(camera, drawn.n)).x;
                to.pixel.push_back(int32_t(int64_t(y_) * camera.width + x_)), to.face.push_back(g.face);
                append(to.b, {b.u, b.v}), append(to.x, {x.x, x.y});
                to.weight.push_back(double(g.count) / (double(options_.spp) * g.drawn.size()));
            }
            DepthBound depth;
            depth.set(camera, corner.data(), map);
            pixel.hits += g.count;
            pixel.farthest = std::max(pixel.farthest, depth.farthest(middle, side_->reach));
            pixel.first = std::min(pixel.first, g.face), pixel.last = std::max(pixel.last, g.face);
            std::atomic_ref<uint8_t> seen(out_.seen[g.face]);
            if (!seen.load(std::memory_order_relaxed))
                seen.store(camera.side(corner[0], corner[1], corner[2]), std::memory_order_relaxed);
        }
        count_ = 0, x_ = -1;
    }

    std::array<Vec3, 3> corners(int32_t face) const {
        const int32_t* v = scene_.faces + 3 * int64_t(face);
        return {side_->q[v[0]], side_->q[v[1]], side_->q[v[2]]};
    }
    bool is_unseen(int32_t face) const { return side_->camera.passes_through_eye(corners(face).data()); }
    // Whether a face shows something, kept for those that come again.
    bool is_known(int32_t face) {
        int32_t& known = known_[unsigned(face) % known_.size()];
        if (known != face && !is_unseen(face)) known = face;
        return known == face;
    }

    const SceneView<T>& scene_;
    const std::deque<Side>& sides_;
    const Side* side_;  // the one that is looked through
    const ImageOptions& options_;
    const PixelChoice& choice_;
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
    std::vector<Pixel> row_;
    int y_ = 0;
    std::array<int32_t, 256> known_ = filled();
    std::vector<Group> groups_;
    int count_ = 0;             // of them, in use
    int x_ = -1, samples_ = 0;  // the pixel that they are of, and how many of its samples came
};

}  // namespace

template <class T>
PixelHits find_pixel_hits(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster,
                          const ImageOptions& options, const PixelChoice& choice, Team& team,
                          const HitBuffers<T>& out) {
    const std::deque<Side> sides = make_sides(scene, camera, caster, options, team);
    std::vector<PixelHits> rows(choice.end - choice.first);
    team.each_with(
        choice.end - choice.first,
        [&] { return std::make_unique<HitRow<T>>(scene, sides, options, choice, out, team); },
        [&](HitRow<T>& row, int64_t k) { row.find(choice.first + int(k), rows[k]); });
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

template PixelHits find_pixel_hits(const SceneView<float>&, const Camera&, const RayCaster&, const ImageOptions&,
                                   const PixelChoice&, Team&, const HitBuffers<float>&);
template PixelHits find_pixel_hits(const SceneView<double>&, const Camera&, const RayCaster&, const ImageOptions&,
                                   const PixelChoice&, Team&, const HitBuffers<double>&);

}  // namespace edgegrad
