// Reads a frame: 8-bit sRGB, or linear radiance in float. Linear values are kept for the box that lines and points
// read.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "core/math.h"

namespace edgegrad {

// Views a frame (H, W, C), C = 1 or 3: of `bytes`, sRGB, or of `linear` radiance; the other is null.
struct FrameView {
    const uint8_t* bytes = nullptr;
    const float* linear = nullptr;
    int width, height, channels;
};

// Holds a box of whole pixels, its end excluded.
struct PixelBox {
    int left = 0, top = 0, right = 0, bottom = 0;

    bool empty() const { return right <= left || bottom <= top; }
    bool holds(const PixelBox& o) const {
        return o.left >= left && o.top >= top && o.right <= right && o.bottom <= bottom;
    }
};

class Frame {
   public:
    static constexpr int levels = 3, bits = 4, bins = 1 << 3 * bits;

    Frame(int width, int height);

    // Begins a frame, which is read until the next one begins.
    void begin(const FrameView& view);

    // Makes linear values available in a box: of all pixels, and of means over 2 x 2 and 4 x 4.
    void require(PixelBox box);

    // Returns the histogram bin of a pixel in the box.
    int bin(int x, int y) const {
        if (!view_.linear) {
            const uint8_t* p = view_.bytes + view_.channels * (int64_t(y) * width_ + x);
            return view_.channels == 3 ? pack(p[0], p[1], p[2]) : p[0] << (3 * bits - 8);
        }
        const float* p = level_[0].data() + 4 * (int64_t(y) * width_ + x);
        return view_.channels == 3 ? pack(srgb_byte(p[0]), srgb_byte(p[1]), srgb_byte(p[2]))
                                   : srgb_byte(p[0]) << (3 * bits - 8);
    }

    // Writes the bilinear value at x, in pixels of level 0, with centres at +0.5; it is constant beyond the box.
    void sample(int level, Vec2 x, float out[4]) const {
        const float scale = 1.0f / float(1 << level);
        const float u = float(x.x) * scale - 0.5f, v = float(x.y) * scale - 0.5f;
        sample_texel(level, u, v, out);
    }
    // Does the same at u, v in pixels of the level, with centres at whole numbers.
    void sample_texel(int level, float u, float v, float out[4]) const {
        const Extent& e = extent_[level];
        // The last interpolated pixel ends just before the border, so that its neighbour is within the box.
        u = std::max(e.left, std::min(u, e.right - 0.001f)), v = std::max(e.top, std::min(v, e.bottom - 0.001f));
        const int i = int(u), j = int(v);
        const float a = u - float(i), b = v - float(j);
        const int right_step = float(i) < e.right ? 4 : 0, down_step = float(j) < e.bottom ? 4 * e.width : 0;
        const float *p = level_[level].data() + 4 * (int64_t(j) * e.width + i), *q = p + down_step;
        for (int k = 0; k < 4; ++k) {
            const float upper = p[k] + a * (p[k + right_step] - p[k]);
            const float lower = q[k] + a * (q[k + right_step] - q[k]);
            out[k] = upper + b * (lower - upper);
        }
    }

    int width() const { return width_; }
    int height() const { return height_; }

   private:
    static int pack(int r, int g, int b) {
        return (r >> (8 - bits)) << 2 * bits | (g >> (8 - bits)) << bits | b >> (8 - bits);
    }
    int srgb_byte(float linear) const { return byte_[int(4095.0f * (linear < 0 ? 0 : linear > 1 ? 1 : linear))]; }
    // Holds the box in pixels of a level: the first ones and the last ones, and the width of its rows.
    struct Extent {
        float left, top, right, bottom;
        int width;
    };

    void read(const PixelBox& box);
    void halve(int level, const PixelBox& box);

    int width_, height_;
    FrameView view_{};
    PixelBox box_;
    std::array<Extent, levels> extent_;
    std::array<float, 256> linear_;
    std::array<uint8_t, 4096> byte_;
    std::array<std::vector<float>, levels> level_;  // (h, w, 4), the last channel unused
};

}  // namespace edgegrad
