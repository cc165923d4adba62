#include "track/frame.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

// IEC 61966-2-1.
double srgb_to_linear(double v) { return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4); }
double linear_to_srgb(double v) { return v <= 0.0031308 ? 12.92 * v : 1.055 * std::pow(v, 1 / 2.4) - 0.055; }

constexpr int grid = 1 << (Frame::levels - 1);  // Boxes begin and end on whole pixels of every level.

}  // namespace

Frame::Frame(int width, int height) : width_(width), height_(height) {
    for (int i = 0; i < 256; ++i) linear_[i] = float(srgb_to_linear(i / 255.0));
    for (int i = 0; i < 4096; ++i) byte_[i] = uint8_t(std::lround(255 * linear_to_srgb((i + 0.5) / 4096)));
    for (int l = 0; l < levels; ++l)
        level_[l].resize(4 * size_t(std::max(1, width >> l)) * size_t(std::max(1, height >> l)), 0.f);
}

void Frame::begin(const FrameView& view) { view_ = view, box_ = {}; }

void Frame::require(PixelBox box) {
    box.left = std::clamp(box.left, 0, width_) / grid * grid, box.top = std::clamp(box.top, 0, height_) / grid * grid;
    const auto up = [](int at, int end) { return std::min((std::clamp(at, 0, end) + grid - 1) / grid * grid, end); };
    box.right = up(box.right, width_), box.bottom = up(box.bottom, height_);
    if (box.empty() || box_.holds(box)) return;
    if (!box_.empty())
        box = {std::min(box.left, box_.left), std::min(box.top, box_.top), std::max(box.right, box_.right),
               std::max(box.bottom, box_.bottom)};
    box_ = box;
    read(box);
    for (int l = 1; l < levels; ++l) halve(l, box);
    for (int l = 0; l < levels; ++l)
        extent_[l] = {float(box.left >> l), float(box.top >> l), float((box.right >> l) - 1),
                      float((box.bottom >> l) - 1), std::max(1, width_ >> l)};
}

void Frame::read(const PixelBox& box) {
    const int C = view_.channels, second = C == 3 ? 1 : 0, third = C == 3 ? 2 : 0;
    for (int y = box.top; y < box.bottom; ++y) {
        const int64_t first = int64_t(y) * width_ + box.left;
        float* out = level_[0].data() + 4 * first;
        const int n = box.right - box.left;
        if (view_.linear) {
            const float* p = view_.linear + C * first;
            for (int i = 0; i < n; ++i, p += C, out += 4) out[0] = p[0], out[1] = p[second], out[2] = p[third];
        } else {
            const uint8_t* p = view_.bytes + C * first;
            for (int i = 0; i < n; ++i, p += C, out += 4)
                out[0] = linear_[p[0]], out[1] = linear_[p[second]], out[2] = linear_[p[third]];
        }
    }
}

void Frame::halve(int level, const PixelBox& box) {
    const int from = std::max(1, width_ >> (level - 1)), to = std::max(1, width_ >> level);
    const int right = std::min(box.right >> level, to),
              bottom = std::min(box.bottom >> level, std::max(1, height_ >> level));
    const float* in = level_[level - 1].data();
    float* out = level_[level].data();
    for (int y = box.top >> level; y < bottom; ++y)
        for (int x = box.left >> level; x < right; ++x) {
            const float *a = in + 4 * (int64_t(2 * y) * from + 2 * x), *b = a + 4 * int64_t(from);
            float* o = out + 4 * (int64_t(y) * to + x);
            for (int k = 0; k < 4; ++k) o[k] = 0.25f * ((a[k] + a[k + 4]) + (b[k] + b[k + 4]));
        }
}

}  // namespace edgegrad
