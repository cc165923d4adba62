// CellMarks marks cells of two by two pixels that segments pass, so that a search can skip empty parts of the image.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/math.h"

namespace edgegrad {

class CellMarks {
   public:
    // Cells is a box of cells, both corners included.
    struct Cells {
        uint16_t i0, j0, i1, j1;
    };

    CellMarks(int width, int height)
        : columns_(index(width) + 1), marked_(size_t(columns_) * (size_t(index(height)) + 1), 0) {}

    static Cells around(Vec2 low, Vec2 high) { return {index(low.x), index(low.y), index(high.x), index(high.y)}; }

    static constexpr int64_t bytes_per_pixel = sizeof(uint8_t);  // upper bound

    // Marks the cells that a segment comes nearer to than `margin`. Any thread may call it.
    void mark(Vec2 a, Vec2 b, double margin) {
        const int parts = 1 + int(std::min(length(b - a) / cell, 0x1p16));
        for (int k = 0; k < parts; ++k) {
            const Vec2 p = a + (double(k) / parts) * (b - a), q = a + (double(k + 1) / parts) * (b - a);
            const Cells c = around({std::min(p.x, q.x) - margin, std::min(p.y, q.y) - margin},
                                   {std::max(p.x, q.x) + margin, std::max(p.y, q.y) + margin});
            each(c, [](uint8_t& marked) { std::atomic_ref(marked).store(1, std::memory_order_relaxed); });
        }
    }

    bool any(const Cells& c) {
        bool found = false;
        each(c, [&](uint8_t& marked) { found |= marked; });
        return found;
    }

   private:
    static constexpr double cell = 2;  // px
    static uint16_t index(double x) { return uint16_t(std::clamp(x / cell, 0.0, 65535.0)); }

    // Points outside the image belong to the cells at its border.
    template <class Body>
    void each(const Cells& c, Body body) {
        const int rows = int(marked_.size()) / columns_, i1 = std::min<int>(c.i1, columns_ - 1),
                  j1 = std::min<int>(c.j1, rows - 1);
        for (int j = std::min<int>(c.j0, rows - 1); j <= j1; ++j)
            for (int i = std::min<int>(c.i0, columns_ - 1); i <= i1; ++i) body(marked_[size_t(j) * columns_ + i]);
    }

    int columns_;
    std::vector<uint8_t> marked_;
};

}  // namespace edgegrad
