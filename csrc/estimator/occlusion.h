// What the image says of occlusion: a curve or a face that lies behind everything that was hit in the pixels it touches
// is most likely occluded. It gets fewer samples, never none, so that nothing is biased.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <vector>

#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// Maxima over squares of 1, 2, 4, … pixels of the depths that the image hit: any box is covered by four squares of one
// level (cf. the hierarchical z-buffer of Greene et al. 1993).
class OcclusionHint {
   public:
    // `depth` (H, W), see HitBuffers; null: nothing is known.
    OcclusionHint(const float* depth, int width, int height, ThreadTeam& team) : width_(width), height_(height) {
        if (!depth) return;
        levels_.push_back({depth, width, height});
        while (levels_.back().width > 1 || levels_.back().height > 1) {
            const Level below = levels_.back();
            const int w = (below.width + 1) / 2, h = (below.height + 1) / 2;
            storage_.emplace_back(size_t(w) * h);
            float* out = storage_.back().data();
            const int rows = std::max(1, (1 << 14) / w);
            team.parallel_for((h + rows - 1) / rows, [&](int64_t k) {
                for (int j = int(k) * rows; j < std::min(h, (int(k) + 1) * rows); ++j)
                    for (int i = 0; i < w; ++i)
                        out[size_t(j) * w + i] = below.of_corners(2 * i, std::min(2 * i + 1, below.width - 1), 2 * j,
                                                                  std::min(2 * j + 1, below.height - 1));
            });
            levels_.push_back({out, w, h});
        }
        if (int(levels_.size()) <= tile_level) return;
        const Level& tiles = levels_[tile_level];
        around_tile_.resize(size_t(tiles.width) * tiles.height);
        team.parallel_for(tiles.height, [&](int64_t j) {
            for (int i = 0; i < tiles.width; ++i)
                around_tile_[j * tiles.width + i] =
                    tiles.of_all(std::max(i - 1, 0), std::min(i + 1, tiles.width - 1), std::max(int(j) - 1, 0),
                                 std::min(int(j) + 1, tiles.height - 1));
        });
    }

    // In how many pixels what lies in this box of the image, no nearer than `nearest`, is behind all that was hit:
    // those of the box and around it; 0 unless in all of them. One pixel around: where a surface is steep, the samples
    // of one pixel miss its farthest part.
    int64_t hiding_pixels(Vec2 low, Vec2 high, double nearest) const {
        if (levels_.empty()) return 0;
        const int i0 = pixel(low.x - 1, width_), i1 = pixel(high.x + 1, width_);
        const int j0 = pixel(low.y - 1, height_), j1 = pixel(high.y + 1, height_);
        // A box no wider than a square of the level touches two of them at most. These reach beyond the box, so if they
        // do not lie before `nearest`, smaller ones may.
        const int k = std::min(int(std::bit_width(unsigned(std::max(i1 - i0, j1 - j0)))), int(levels_.size()) - 1);
        const auto farthest = [&](int k) { return levels_[k].of_all(i0 >> k, i1 >> k, j0 >> k, j1 >> k); };
        const bool hidden = nearest > levels_[k].of_corners(i0 >> k, i1 >> k, j0 >> k, j1 >> k) ||
                            (k > 0 && nearest > farthest(std::max(0, k - 2)));
        return hidden ? int64_t(i1 - i0 + 1) * (j1 - j0 + 1) : 0;
    }

    // Whether what lies within `reach` px of x, no nearer than `nearest`, is behind all that was hit in the tile of x
    // and those around it: a coarse answer in one look.
    static constexpr int tile = 8;  // px
    static constexpr double reach = tile - 1;
    static constexpr int64_t pixels_around = 9 * tile * tile;
    bool hides_around(Vec2 x, double nearest) const {
        return !around_tile_.empty() && nearest > around_tile_[tile_of(x)];
    }
    int width() const { return width_; }
    int height() const { return height_; }
    int columns() const { return (width_ + tile - 1) / tile; }
    int rows() const { return (height_ + tile - 1) / tile; }
    int tile_of(Vec2 x) const { return pixel(x.y, height_) / tile * columns() + pixel(x.x, width_) / tile; }

    // What the density of samples is multiplied by where something is hidden, by how many rays say so. Let gaps show V
    // of the R px² in which it is hidden. All n = spp · R rays miss them with probability exp(−spp V). At 1/D of the
    // density what shows has D V/R of the variance that it would have were all of it visible; in the mean over what
    // rays find, D V/R exp(−spp V) ≤ D / (e n). So D may grow with n: with n / rays that is rays / e at most. One
    // sample stands for no more than a share of the image; or, where that is less, as in a small image, D for no more
    // than 1 / least.
    struct Few {
        double rays, share, least;
    };
    // The same where it is `least` with 16 samples a pixel: fewer miss more of what shows through a gap.
    static double factor(double least, int spp) { return std::min(1.0, least * std::max(1.0, 16.0 / spp)); }
    double factor(Few few, double pixels, int spp) const {
        const double most = std::max(1 / few.least, few.share * width_ * height_);
        return 1 / std::clamp(spp * pixels / few.rays, 1.0, most);
    }

   private:
    struct Level {
        const float* depth;
        int width, height;

        // The farthest of all squares of a box.
        float of_all(int i0, int i1, int j0, int j1) const {
            float out = -std::numeric_limits<float>::infinity();
            for (int j = j0; j <= j1; ++j)
                for (int i = i0; i <= i1; ++i) out = std::max(out, depth[size_t(j) * width + i]);
            return out;
        }

        // The farthest of the four squares at the corners of a box.
        float of_corners(int i0, int i1, int j0, int j1) const {
            const auto at = [&](int i, int j) { return depth[size_t(j) * width + i]; };
            return std::max(std::max(at(i0, j0), at(i1, j0)), std::max(at(i0, j1), at(i1, j1)));
        }
    };
    static int pixel(double x, int count) { return int(std::min(std::max(x, 0.0), double(count - 1))); }

    static constexpr int tile_level = 3;
    static_assert(tile == 1 << tile_level);
    int width_, height_;
    std::vector<std::vector<float>> storage_;
    std::vector<Level> levels_;
    std::vector<float> around_tile_;  // the farthest of a tile and those around it
};

}  // namespace edgegrad
