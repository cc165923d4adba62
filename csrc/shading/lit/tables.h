// Holds the tensors of lit scenes as tables of rows, and the cotangents of the rows. Tables store vertices, normals,
// texture coordinates, texels and constants.
#pragma once

#include <cstdint>
#include <vector>

#include "accumulate/scatter.h"
#include "core/dual.h"

namespace edgegrad {

constexpr int no_table = -1;
constexpr int most_lit_channels = 16;

struct Table {
    const void* values = nullptr;
    bool wide = false;  // Values are double, otherwise float.
    int64_t rows = 0;
    int width = 0;
    const double* tangent = nullptr;  // Null means zero.

    double number(int64_t i) const {
        return wide ? static_cast<const double*>(values)[i] : double(static_cast<const float*>(values)[i]);
    }
    template <class S>
    S at(int64_t row, int column = 0) const {
        const int64_t i = row * width + column;
        if constexpr (std::is_same_v<S, double>) return number(i);
        else return {number(i), tangent ? tangent[i] : 0};
    }
    // Returns the first three columns.
    template <class S>
    Vector<S> vector_at(int64_t row) const {
        return vector(at<S>(row, 0), at<S>(row, 1), at<S>(row, 2));
    }
    // Returns one channel; a row of one number serves all channels.
    template <class S>
    S channel(int64_t row, int c) const {
        return at<S>(row, width == 1 ? 0 : c);
    }
};

// Points to the gradient of a table, in double or in float. Both are null if it is not wanted.
struct TableBar {
    double* wide = nullptr;
    float* narrow = nullptr;

    bool is_wanted() const { return wide || narrow; }
};

// Buffers the cotangents of one chunk of points, one buffer for each table. Tables that are not wanted ignore theirs.
class Cotangents {
   public:
    void prepare(const std::vector<Table>& tables, const std::vector<TableBar>& to, int owners) {
        of_.resize(tables.size());
        for (size_t i = 0; i < tables.size(); ++i) {
            if (to[i].is_wanted()) of_[i].prepare(tables[i].width, owners);
            of_[i].clear();
        }
    }
    bool wants(int table) const { return table != no_table && of_[table].is_wanted(); }
    void add(int table, int64_t row, const double* bar) {
        if (wants(table)) of_[table].add(row, bar);
    }
    void add(int table, int64_t row, Vec3 bar) {
        const double row_bar[3] = {bar.x, bar.y, bar.z};
        add(table, row, row_bar);
    }
    // Adds the cotangents of channels; a row may have one number for all of them.
    void add_channels(int table, int64_t row, int width, int channels, const double* bar) {
        if (!wants(table)) return;
        if (width > 1 || channels == 1) return of_[table].add(row, bar);
        double sum = 0;
        for (int c = 0; c < channels; ++c) sum += bar[c];
        of_[table].add(row, &sum);
    }
    void add_to(const std::vector<TableBar>& to, int owner) const {
        for (size_t i = 0; i < to.size(); ++i) {
            if (to[i].wide) of_[i].add_to(to[i].wide, owner);
            if (to[i].narrow) of_[i].add_to(to[i].narrow, owner);
        }
    }

   private:
    std::vector<RowBuffer> of_;
};

}  // namespace edgegrad
