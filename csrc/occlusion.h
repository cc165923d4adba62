// What the image says of occlusion: a curve or a face that lies behind everything that was hit in the pixels it touches
// is most likely occluded. It gets fewer samples, never none, so that nothing is biased.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <vector>

#include "math.h"
#include "parallel.h"

namespace edgegrad {

// Maxima over squares of 1, 2, 4, … pixels of the depths that the image hit: any box is covered by four squares of one
// level (cf. the hierarchical z-buffer of Greene et al. 1993).
class OcclusionHint {
   public:
    // `depth` (H, W), see ForwardOutput; null: nothing is known.
    OcclusionHint(const float* depth, int width, int height, Team& team) {
        if (!depth) return;
        levels_.push_back({depth, width, height});
        while (levels_.back().width > 1 || levels_.back().height > 1) {
            const Level below = levels_.back();
            const int w = (below.width + 1) / 2, h = (below.height + 1) / 2;
            storage_.emplace_back(size_t(w) * h);
            float* out = storage_.back().data();
            const int rows = std::max(1, (1 << 14) / w);
            team.each((h + rows - 1) / rows, [&](int64_t k) {
                for (int j = int(k) * rows; j < std::min(h, (int(k) + 1) * rows); ++j)
                    for (int i = 0; i < w; ++i)
                        out[size_t(j) * w + i] = below.farthest(2 * i, std::min(2 * i + 1, below.width - 1), 2 * j,
                                                                std::min(2 * j + 1, below.height - 1));
            });
            levels_.push_back({out, w, h});
        }
    }

    // Whether what lies in this box of the image, no nearer than `nearest`, is behind all that was hit there, and in
    // one pixel around it: where a surface is steep, the samples of one pixel miss its farthest part.
    bool hides(Vec2 low, Vec2 high, double nearest) const {
        if (levels_.empty()) return false;
        const Level& image = levels_[0];
        const int i0 = pixel(low.x - 1, image.width), i1 = pixel(high.x + 1, image.width);
        const int j0 = pixel(low.y - 1, image.height), j1 = pixel(high.y + 1, image.height);
        // A box no wider than a square of the level touches two of them at most.
        const int k = std::min(int(std::bit_width(unsigned(std::max(i1 - i0, j1 - j0)))), int(levels_.size()) - 1);
        return nearest > levels_[k].farthest(i0 >> k, i1 >> k, j0 >> k, j1 >> k);
    }

    // What the density of samples is multiplied by where something is hidden, if it is `least` with 16 samples a pixel:
    // fewer miss more of what shows through a gap.
    static double factor(double least, int spp) { return std::min(1.0, least * std::max(1.0, 16.0 / spp)); }

   private:
    struct Level {
        const float* depth;
        int width, height;

        // Of the four squares at the corners of a box.
        float farthest(int i0, int i1, int j0, int j1) const {
            const auto at = [&](int i, int j) { return depth[size_t(j) * width + i]; };
            return std::max(std::max(at(i0, j0), at(i1, j0)), std::max(at(i0, j1), at(i1, j1)));
        }
    };
    static int pixel(double x, int count) { return int(std::clamp(std::floor(x), 0.0, double(count - 1))); }

    std::vector<std::vector<float>> storage_;
    std::vector<Level> levels_;
};

}  // namespace edgegrad
