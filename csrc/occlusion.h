// What the image says of occlusion: a curve or a face that lies behind everything that was hit in the pixels it touches
// is most likely occluded, and one before which nothing was hit is most likely visible. Either gets fewer samples,
// never none, so that nothing is biased.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <vector>

#include "math.h"
#include "parallel.h"

namespace edgegrad {

// Minima and maxima over squares of 1, 2, 4, … pixels of the depths that the image hit: any box is covered by four
// squares of one level (cf. the hierarchical z-buffer of Greene et al. 1993).
class OcclusionHint {
   public:
    // `depths` (H, W, 2), see ForwardOutput; null: nothing is known.
    OcclusionHint(const float* depths, int width, int height, Team& team) {
        if (!depths) return;
        levels_.push_back({depths, width, height});
        while (levels_.back().width > 1 || levels_.back().height > 1) {
            const Level below = levels_.back();
            const int w = (below.width + 1) / 2, h = (below.height + 1) / 2;
            storage_.emplace_back(2 * size_t(w) * h);
            float* out = storage_.back().data();
            const int rows = std::max(1, (1 << 14) / w);
            team.each((h + rows - 1) / rows, [&](int64_t k) {
                for (int j = int(k) * rows; j < std::min(h, (int(k) + 1) * rows); ++j)
                    for (int i = 0; i < w; ++i) {
                        const Range r = below.around(2 * i, std::min(2 * i + 1, below.width - 1), 2 * j,
                                                     std::min(2 * j + 1, below.height - 1));
                        out[2 * (size_t(j) * w + i)] = r.nearest, out[2 * (size_t(j) * w + i) + 1] = r.farthest;
                    }
            });
            levels_.push_back({out, w, h});
        }
    }

    // Whether what lies in this box of the image, no nearer than `nearest`, is behind all that was hit there.
    bool hides(Vec2 low, Vec2 high, double nearest) const {
        return !levels_.empty() && nearest > around(low, high).farthest;
    }

    // Whether nothing that was hit in the pixels of this box lies before a depth; these are found to within margin().
    bool exposes(Vec2 low, Vec2 high, double depth) const {
        if (levels_.empty()) return false;
        const int k = std::min(level_of(low, high), int(levels_.size()) - 1);
        const Level& level = levels_[k];
        const int i0 = pixel(low.x, levels_[0].width) >> k, i1 = pixel(high.x, levels_[0].width) >> k;
        const int j0 = pixel(low.y, levels_[0].height) >> k, j1 = pixel(high.y, levels_[0].height) >> k;
        for (int j = j0; j <= j1; ++j)
            for (int i = i0; i <= i1; ++i)
                if (level.depths[2 * (size_t(j) * level.width + i)] < depth) return false;
        return true;
    }
    // px around the middle of the box.
    static double margin(Vec2 low, Vec2 high) {
        return std::max(high.x - low.x, high.y - low.y) / 2 + double(1 << level_of(low, high)) + 1;
    }

    // What the density of samples is multiplied by where something is hidden, if it is `least` with 16 samples a pixel:
    // fewer miss more of what shows through a gap.
    static double factor(double least, int spp) { return std::min(1.0, least * std::max(1.0, 16.0 / spp)); }

   private:
    // Squares of which a box has five or fewer a side.
    static int level_of(Vec2 low, Vec2 high) {
        const double side = std::min(std::max(high.x - low.x, high.y - low.y), 65536.0);
        return std::max(0, int(std::bit_width(unsigned(side))) - 2);
    }
    struct Range {
        float nearest, farthest;
    };
    struct Level {
        const float* depths;
        int width, height;

        // Of the four squares at the corners of a box.
        Range around(int i0, int i1, int j0, int j1) const {
            const auto at = [&](int i, int j) { return depths + 2 * (size_t(j) * width + i); };
            const float *a = at(i0, j0), *b = at(i1, j0), *c = at(i0, j1), *d = at(i1, j1);
            return {std::min(std::min(a[0], b[0]), std::min(c[0], d[0])),
                    std::max(std::max(a[1], b[1]), std::max(c[1], d[1]))};
        }
    };

    // Of a box and one pixel around it: where a surface is steep, the samples of one pixel miss its farthest part.
    Range around(Vec2 low, Vec2 high) const {
        const Level& image = levels_[0];
        const int i0 = pixel(low.x - 1, image.width), i1 = pixel(high.x + 1, image.width);
        const int j0 = pixel(low.y - 1, image.height), j1 = pixel(high.y + 1, image.height);
        // A box no wider than a square of the level touches two of them at most.
        const int k = std::min(int(std::bit_width(unsigned(std::max(i1 - i0, j1 - j0)))), int(levels_.size()) - 1);
        return levels_[k].around(i0 >> k, i1 >> k, j0 >> k, j1 >> k);
    }
    static int pixel(double x, int count) { return int(std::clamp(std::floor(x), 0.0, double(count - 1))); }

    std::vector<std::vector<float>> storage_;
    std::vector<Level> levels_;
};

}  // namespace edgegrad
