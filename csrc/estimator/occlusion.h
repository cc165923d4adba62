// This file predicts occlusion from the image. A curve or a face behind everything that was hit in the pixels it
// touches is most likely occluded. It gets fewer samples, but never none, so the estimate is unbiased.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <vector>

#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// OcclusionHint holds maxima of the hit depths over squares of 1, 2, 4, … pixels. Four squares of one level cover any
// box (cf. the hierarchical z-buffer of Greene et al. 1993).
class OcclusionHint {
   public:
    // For `depth` (H, W) see HitBuffers; null: nothing is known.
    OcclusionHint(const float* depth, int width, int height, ThreadTeam& team) : width_(width), height_(height) {
        if (!depth) return;
        levels_.push_back({depth, width, height});
        while (levels_.back().width > 1 || levels_.back().height > 1) {
            const DepthLevel below = levels_.back();
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
        const DepthLevel& tiles = levels_[tile_level];
        around_tile_.resize(size_t(tiles.width) * tiles.height);
        team.parallel_for(tiles.height, [&](int64_t j) {
            for (int i = 0; i < tiles.width; ++i)
                around_tile_[j * tiles.width + i] =
                    tiles.of_all(std::max(i - 1, 0), std::min(i + 1, tiles.width - 1), std::max(int(j) - 1, 0),
                                 std::min(int(j) + 1, tiles.height - 1));
        });
    }

    // Returns the number of pixels in and around a box if its content, no nearer than `nearest`, is behind all hits in
    // each; else 0. One pixel around is included, as on a steep surface one pixel's samples miss its farthest part.
    int64_t hiding_pixels(Vec2 low, Vec2 high, double nearest) const {
        if (levels_.empty()) return 0;
        const int i0 = pixel(low.x - 1, width_), i1 = pixel(high.x + 1, width_);
        const int j0 = pixel(low.y - 1, height_), j1 = pixel(high.y + 1, height_);
        // A box no wider than a square of the level touches at most two of them. These reach beyond the box, so smaller
        // squares are tested if they do not decide.
        const int k = std::min(int(std::bit_width(unsigned(std::max(i1 - i0, j1 - j0)))), int(levels_.size()) - 1);
        const auto farthest = [&](int k) { return levels_[k].of_all(i0 >> k, i1 >> k, j0 >> k, j1 >> k); };
        const bool hidden = nearest > levels_[k].of_corners(i0 >> k, i1 >> k, j0 >> k, j1 >> k) ||
                            (k > 0 && nearest > farthest(std::max(0, k - 2)));
        return hidden ? int64_t(i1 - i0 + 1) * (j1 - j0 + 1) : 0;
    }

    // hides_around() returns whether what lies within `reach` px of x, no nearer than `nearest`, is behind all hits in
    // the tile of x and its neighbours. This is a coarse answer from one look-up.
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

    // HiddenFactor sets the factor on the density of samples where something is hidden, by the number of rays that say
    // so. Let gaps show V of the R px² in which it is hidden. All n = spp · R rays miss them with probability exp(−spp
    // V). At 1/D of the density, the visible part has D V/R of the variance that it would have were all of it visible.
    // On average over what rays find, D V/R exp(−spp V) ≤ D / (e n). D may therefore grow with n; D = n / rays bounds
    // this by 1 / (e rays). One sample stands for at most `share` of the image. In a small image, where that is less, D
    // is at most 1 / least instead.
    struct HiddenFactor {
        double rays, share, least;
    };
    // factor() takes the value `least` at 16 samples per pixel. Fewer samples miss more of what shows through a gap.
    static double factor(double least, int spp) { return std::min(1.0, least * std::max(1.0, 16.0 / spp)); }
    double factor(HiddenFactor hidden, double pixels, int spp) const {
        const double most = std::max(1 / hidden.least, hidden.share * width_ * height_);
        return 1 / std::clamp(spp * pixels / hidden.rays, 1.0, most);
    }

   private:
    struct DepthLevel {
        const float* depth;
        int width, height;

        // Returns the largest depth of all squares of a box.
        float of_all(int i0, int i1, int j0, int j1) const {
            float out = -std::numeric_limits<float>::infinity();
            for (int j = j0; j <= j1; ++j)
                for (int i = i0; i <= i1; ++i) out = std::max(out, depth[size_t(j) * width + i]);
            return out;
        }

        // Returns the largest depth of the four squares at the corners of a box.
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
    std::vector<DepthLevel> levels_;
    std::vector<float> around_tile_;  // largest depth of a tile and its neighbours
};

}  // namespace edgegrad
