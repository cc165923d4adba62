// Contains the pixel loop. The samples of a pixel are drawn in proportion to the filter and cast together.

#include "forward/forward.h"

#include <algorithm>
#include <atomic>
#include <bit>
#include <cmath>
#include <deque>
#include <limits>
#include <numeric>
#include <vector>

#include "camera/depth_bound.h"
#include "camera/sub_cameras.h"
#include "camera/vertices.h"
#include "core/channels.h"
#include "core/sampler.h"
#include "forward/reachable.h"
#include "forward/sub_camera_rays.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

constexpr int lanes = 8;

// Returns a mask of the lanes that hit the face.
inline unsigned on_face(const int32_t* hit, int32_t face) {
    static constexpr unsigned bit[lanes] = {1, 2, 4, 8, 16, 32, 64, 128};
    unsigned bits = 0;
    EDGEGRAD_ROLLED for (int i = 0; i < lanes; ++i) bits |= hit[i] == face ? bit[i] : 0;
    return bits;
}

// Adds the barycentrics of all lanes that hit the face. Returns false if one of them lies outside of it. All lanes are
// computed without branches, so that they fill vectors. The order of the sum does not depend on the vectors' width.
EDGEGRAD_VECTORIZED bool add_barycentrics(const FaceMap& map, const double* x, const double* y, const int32_t* hit,
                                          int32_t face, Barycentrics& sum) {
    const Vec3 a = map.column[0], b = map.column[1], c = map.column[2];
    double u[lanes], v[lanes];
    int64_t outside = 0;
    for (int i = 0; i < lanes; ++i) {
        const double inverse = 1.0 / (x[i] * a.z + y[i] * b.z + c.z);
        u[i] = (x[i] * a.x + y[i] * b.x + c.x) * inverse, v[i] = (x[i] * a.y + y[i] * b.y + c.y) * inverse;
        const bool on = hit[i] == face;
        outside |= int64_t(on) & ~int64_t((u[i] >= 0) & (v[i] >= 0) & (u[i] + v[i] <= 1));
        u[i] = on ? u[i] : 0.0, v[i] = on ? v[i] : 0.0;
    }
    for (int i = 0; i < 4; ++i) u[i] += u[i + 4], v[i] += v[i + 4];
    sum.u += (u[0] + u[2]) + (u[1] + u[3]), sum.v += (v[0] + v[2]) + (v[1] + v[3]);
    return !outside;
}

constexpr int tile = 16;

// Renders the pixels of one row of a tile.
template <int N, class T>
class PixelRow {
   public:
    PixelRow(const SceneView<T>& scene, const std::deque<SubCameraRays>& sub_cameras, const ImageOptions& options,
             ThreadTeam& team, T* image, const HitBuffers<T>& out)
        : scene_(scene),
          sub_cameras_(sub_cameras),
          sub_camera_(&sub_cameras.front()),
          spp_(options.spp),
          radius_(options.filter.radius()),
          team_(team),
          image_(image),
          out_(out),
          C_(channels_of<N>(scene)),
          direction_(scene.attributes.unit < 0 ? -1 : scene.radiance + direction_of(scene.attributes)),
          rays_(sub_camera_->frame),
          sum_(tile * C_),
          radiance_(C_) {}

    void render(int x0, int x1, int y) {
        std::fill(sum_.begin(), sum_.end(), 0.0);
        std::fill(hits_, hits_ + tile, 0);
        std::fill(first_, first_ + tile, std::numeric_limits<int32_t>::max());
        std::fill(last_, last_ + tile, -1);
        std::fill(farthest_, farthest_ + tile, -std::numeric_limits<double>::infinity());
        x0_ = x0, y_ = y;
        for (const SubCameraRays& sub_camera : sub_cameras_) add_sub_camera(sub_camera, x0, x1);
        for (int x = 0; x < x1 - x0; ++x) {
            const int64_t pixel = pixel_at(x0 + x, y);
            const double share = double(hits_[x]) / spp_;
            const T* behind = scene_.background_at(pixel);
            for (int c = 0; c < C_; ++c) image_[pixel * C_ + c] = T(sum_[x * C_ + c] / spp_ + (1 - share) * behind[c]);
            out_.coverage[pixel] = T(share);
            out_.depth[pixel] = hits_[x] == spp_ ? rounded_up(farthest_[x]) : std::numeric_limits<float>::infinity();
            out_.hit[2 * pixel] = hits_[x] ? first_[x] : -1, out_.hit[2 * pixel + 1] = last_[x];
        }
    }

    // Does the same where no ray can hit anything.
    void fill_background(int x0, int x1, int y) {
        for (int x = x0; x < x1; ++x) {
            const int64_t pixel = pixel_at(x, y);
            const T* behind = scene_.background_at(pixel);
            std::copy(behind, behind + C_, image_ + pixel * C_);
            out_.coverage[pixel] = 0;
            out_.depth[pixel] = std::numeric_limits<float>::infinity();
            out_.hit[2 * pixel] = out_.hit[2 * pixel + 1] = -1;
        }
    }

   private:
    // Holds what the samples on one face share. Some are kept, as faces alternate in a pixel and recur in the next.
    struct alignas(N ? 256 : 8) Shaded {
        int32_t face = -1;
        bool textured = false, edge_on = false;
        FaceMap map;
        DepthBound depth;
        AffineRadiance<N> radiance;
    };
    static constexpr unsigned n_kept = 64;

    int64_t pixel_at(int x, int y) const { return int64_t(y) * sub_camera_->camera.width + x; }

    // Adds what the pixels of the row see through one sub-camera.
    void add_sub_camera(const SubCameraRays& sub_camera, int x0, int x1) {
        const Camera& camera = sub_camera.camera;
        if (!camera.may_show({0.5 * (x0 + x1), y_ + 0.5}, 0.5 * (x1 - x0) + radius_)) return;
        if (&sub_camera != sub_camera_) {
            sub_camera_ = &sub_camera, rays_.look_through(sub_camera.frame);
            for (Shaded& s : kept_) s.face = -1;
        }
        for (int x = x0; x < x1; ++x) {
            if (!camera.may_show({x + 0.5, y_ + 0.5}, radius_)) continue;
            for (int done = 0; done < spp_;) {
                const int n = std::min(spp_ - done, RayBatch::size - rays_.count);
                sub_camera.pixel_rays.append(x, y_, done, n, rays_);
                runs_[n_runs_++] = {x - x0, n};
                done += n;
                if (rays_.count == RayBatch::size) trace();
            }
        }
        trace();
    }

    void trace() {
        if (++traced_ % 16 == 0) team_.check();
        rays_.prepare();
        sub_camera_->frame.cast(rays_);
        if (scene_.n_faces > in_cache) prefetch_faces();
        int i = 0;
        for (int p = 0; p < n_runs_; ++p) {
            typename AffineRadiance<N>::Sum sum(C_);
            int hits = 0;
            const int end = i + runs_[p].n;
            for (; i + lanes <= end; i += lanes)
                for (unsigned left = (1u << lanes) - 1 - on_face(rays_.face + i, -1); left;) {
                    const int first = std::countr_zero(left);
                    const int32_t face = rays_.face[i + first];
                    const Shaded& s = shaded(face);
                    if (s.edge_on) [[unlikely]] {
                        cast_beyond();
                        left &= ~on_face(rays_.face + i, -1);
                        continue;
                    }
                    const unsigned same = on_face(rays_.face + i, face);
                    left &= ~same;
                    Barycentrics b;
                    if ((same & (same - 1)) && !s.textured &&
                        add_barycentrics(s.map, rays_.n_x + i, rays_.n_y + i, rays_.face + i, face, b)) {
                        const int n = std::popcount(same);
                        s.radiance.add_to(sum, b, n);
                        if (direction_ >= 0)
                            for (unsigned one = same; one; one &= one - 1)
                                add_direction(s, barycentrics_of_hit(s.map, rays_.n(i + std::countr_zero(one))), sum);
                        hits += n;
                        note_hit(s, runs_[p].column);
                    } else {
                        for (unsigned one = same; one; one &= one - 1)
                            hits += add(i + std::countr_zero(one), runs_[p].column, sum);
                    }
                }
            for (; i < end; ++i) {
                if (rays_.face[i] >= 0 && shaded(rays_.face[i]).edge_on) [[unlikely]]
                    cast_beyond();
                if (rays_.face[i] >= 0) hits += add(i, runs_[p].column, sum);
            }
            hits_[runs_[p].column] += hits;
            for (int c = 0; c < C_; ++c) sum_[runs_[p].column * C_ + c] += sum[c];
        }
        rays_.count = n_runs_ = 0;
    }

    // Records that a pixel hits a face, and its depth.
    void note_hit(const Shaded& s, int column) {
        first_[column] = std::min(first_[column], s.face), last_[column] = std::max(last_[column], s.face);
        const Vec2 middle = normalised(sub_camera_->camera, {x0_ + column + 0.5, y_ + 0.5});
        farthest_[column] = std::max(farthest_[column], s.depth.farthest(middle, sub_camera_->reach));
    }

    // Adds the sample of ray i, of a pixel in this column, to the sum.
    int add(int i, int column, typename AffineRadiance<N>::Sum& sum) {
        const int32_t face = rays_.face[i];
        const Shaded& s = shaded(face);
        note_hit(s, column);
        const Barycentrics b = barycentrics_of_hit(s.map, rays_.n(i));
        if (s.textured) {
            shade<N>(scene_, face, b, radiance_.data());
            for (int c = 0; c < C_; ++c) sum[c] += radiance_[c];
        } else {
            s.radiance.add_to(sum, b, 1);
            if (direction_ >= 0) add_direction(s, b, sum);
        }
        return 1;
    }

    void add_direction(const Shaded& s, Barycentrics b, typename AffineRadiance<N>::Sum& sum) const {
        const Vec3 n = unit(interpolated_direction(scene_, s.face, b));
        sum[direction_] += n.x, sum[direction_ + 1] += n.y, sum[direction_ + 2] += n.z;
    }

    Shaded& shaded(int32_t face) {
        Shaded& s = kept_[unsigned(face) % n_kept];
        if (face != s.face) keep(s, face);
        return s;
    }

    // Faces smaller than the spacing of samples are hit once each, so their arrays are prefetched.
    static constexpr int64_t in_cache = 1 << 18;
    void prefetch_faces() const {
        for (int i = 0; i < rays_.count; ++i)
            if (const int64_t face = rays_.face[i]; face >= 0) {
                prefetch(scene_.faces + 3 * face);
                prefetch(scene_.corners + 3 * face);
            }
        for (int i = 0; i < rays_.count; ++i)
            if (const int64_t face = rays_.face[i]; face >= 0)
                for (int k = 0; k < 3; ++k) {
                    prefetch(&sub_camera_->q[scene_.faces[3 * face + k]]);
                    if (!is_textured(scene_, face))
                        prefetch(scene_.colors + int64_t(scene_.corners[3 * face + k]) * scene_.radiance);
                }
    }

    // Casts the rays again, through faces whose plane contains the eye. Other hits stay the same.
    void cast_beyond() {
        rays_.prepare();
        sub_camera_->frame.cast_with_alpha_test(rays_, nullptr, [&](int32_t face) { return !is_edge_on(face); });
    }

    bool is_edge_on(int32_t face) const {
        const int32_t* v = scene_.faces + 3 * int64_t(face);
        const Array<Vec3>& q = sub_camera_->q;
        const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
        return sub_camera_->camera.passes_through_eye(corner);
    }

    void keep(Shaded& s, int32_t face) {
        s.face = face;
        s.textured = is_textured(scene_, face);
        const int32_t* v = scene_.faces + 3 * int64_t(face);
        const Camera& camera = sub_camera_->camera;
        const Array<Vec3>& q = sub_camera_->q;
        const Vec3 corner[3] = {q[v[0]], q[v[1]], q[v[2]]};
        s.map = face_map(camera, corner);
        s.edge_on = camera.passes_through_eye(corner);
        if (s.edge_on) return;
        s.depth.set(camera, corner, s.map);
        if (!s.textured) s.radiance.set(scene_, face);
        // Threads may write the same byte, always with the same value. Reading first keeps its cache line shared.
        std::atomic_ref<uint8_t> seen(out_.seen[face]);
        if (!seen.load(std::memory_order_relaxed))
            seen.store(camera.side(corner[0], corner[1], corner[2]), std::memory_order_relaxed);
    }

    const SceneView<T>& scene_;
    const std::deque<SubCameraRays>& sub_cameras_;
    const SubCameraRays* sub_camera_;  // The rays pass through this sub-camera.
    const int spp_;
    const double radius_;  // filter's radius
    ThreadTeam& team_;
    T* const image_;  // (H, W, C)
    const HitBuffers<T>& out_;
    const int C_;
    const int direction_;  // A direction begins at this channel; −1: there is none.

    struct PixelRun {
        int column, n;
    };
    CameraRays rays_;
    PixelRun runs_[RayBatch::size];  // map rays to pixels
    int n_runs_ = 0;
    unsigned traced_ = 0;
    Shaded kept_[n_kept];
    int x0_ = 0, y_ = 0;  // first pixel of the row
    int hits_[tile];
    int32_t first_[tile], last_[tile];  // faces
    double farthest_[tile];
    std::vector<double> sum_, radiance_;
};

template <int N, class T>
void render_pixels(const SceneView<T>& scene, const std::deque<SubCameraRays>& sub_cameras, const RayCaster& caster,
                   const ImageOptions& o, ThreadTeam& team, T* image, const HitBuffers<T>& out) {
    const Camera& camera = sub_cameras.front().camera;
    // Tiles are lower where a pixel has many samples, so that the threads end together.
    const int rows = std::clamp((1 << 16) / o.spp, 1, tile);
    const int tiles_x = (camera.width + tile - 1) / tile, tiles_y = (camera.height + rows - 1) / rows;
    // Only whole batches are skipped, because the rays of a batch also determine how sums are rounded.
    const int unit = std::min(tile, pixels_of_batches(o.spp));
    const ReachablePixels reachable(camera, caster, sub_cameras.front().q, o.filter.radius() - 0.5, team);
    team.parallel_for_with_state(
        int64_t(tiles_x) * tiles_y,
        [&] { return std::make_unique<PixelRow<N, T>>(scene, sub_cameras, o, team, image, out); },
        [&](PixelRow<N, T>& row, int64_t t) {
            const int x0 = int(t % tiles_x) * tile, x1 = std::min(x0 + tile, camera.width);
            const int y0 = int(t / tiles_x) * rows, y1 = std::min(y0 + rows, camera.height);
            for (int y = y0; y < y1; ++y) {
                const auto [first, end] = reachable.row(y);
                const int from = x0 + (std::clamp(first, x0, x1) - x0) / unit * unit;
                const int to = std::min(x1, x0 + (std::clamp(end, from, x1) - x0 + unit - 1) / unit * unit);
                row.fill_background(x0, from, y), row.render(from, to, y), row.fill_background(to, x1, y);
            }
        });
}

}  // namespace

template <class T>
void render_forward(const SceneView<T>& scene, const Camera& camera, const RayCaster& caster, const ImageOptions& o,
                    ThreadTeam& team, T* image, const HitBuffers<T>& out) {
    const std::deque<SubCameraRays> sub_cameras = make_sub_camera_rays(scene, camera, caster, o, team);
    std::fill(out.seen, out.seen + scene.n_faces, uint8_t(0));
    dispatch_channels(scene.channels, scene.channels > scene.radiance,
                      [&]<int N>() { render_pixels<N>(scene, sub_cameras, caster, o, team, image, out); });
}

template void render_forward(const SceneView<float>&, const Camera&, const RayCaster&, const ImageOptions&, ThreadTeam&,
                             float*, const HitBuffers<float>&);
template void render_forward(const SceneView<double>&, const Camera&, const RayCaster&, const ImageOptions&,
                             ThreadTeam&, double*, const HitBuffers<double>&);

}  // namespace edgegrad
