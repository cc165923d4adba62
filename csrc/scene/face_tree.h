// Boxes of faces in a tree, to find which of them overlap.
//
// Faces are sorted along a space-filling curve (Morton 1966); eight in a row are a leaf, eight leaves in a row a node,
// and so on. The order is kept while the faces move, as long as it is nearly as good as when it was made; boxes are
// made anew.
#pragma once

#include <bit>
#include <cstdint>
#include <vector>

#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

// An order of faces in which neighbours lie near one another.
struct FaceOrder {
    std::vector<int32_t> face;
    double spread = 0;  // mean size of a leaf's box relative to that of all, when it was made
};

struct FaceBox {
    float low[3], high[3];
};

// Eight boxes side by side. Those that are missing are empty.
struct BoxGroup {
    static constexpr int size = 8;
    float low[3][size], high[3][size];

    void set(int lane, const FaceBox& box);
    FaceBox box(int lane) const;
    FaceBox bounds() const;

    // Bit i: box i overlaps this one.
    unsigned overlapping(const FaceBox& box) const;
};

// The plane of a face as its neighbours are compared with it.
struct FacePlane {
    const int32_t* vertex;  // 3, of the face
    Vec3 origin, normal;
    double slack;  // what doubles leave of normal · (p − origin)
};

// The corners of eight faces, relative to one of them, so that floats hold them well.
struct CornerGroup {
    static constexpr int size = BoxGroup::size;
    Vec3 origin;
    float reach;              // the largest of the numbers in p
    float p[3][3][size];      // by corner and axis
    int32_t vertex[3][size];  // −1: there is no face

    // Bit i: face i shares at most one vertex with a face, and its others lie neither all before the plane of that face
    // nor all behind it, as far as floats tell. Of most neighbours this says all.
    unsigned may_cross(const FacePlane& plane) const;
};

class FaceTree {
   public:
    static constexpr int leaf_size = BoxGroup::size;

    // At these positions (V, 3). Makes the order where there is none, or one that fits no more.
    FaceTree(const int32_t* faces, int64_t n_faces, const double* verts, FaceOrder& order, Team& team);

    int64_t n_leaves() const { return levels_[0].size(); }
    const BoxGroup& leaf(int64_t i) const { return levels_[0][i]; }
    FaceBox bounds(int64_t leaf) const {
        return levels_.size() == 1 ? levels_[0][0].bounds()
                                   : levels_[1][leaf / BoxGroup::size].box(int(leaf % BoxGroup::size));
    }
    const CornerGroup& corners(int64_t leaf) const { return corners_[leaf]; }
    // Of leaf and lane; −1: none.
    int32_t face(int64_t leaf, int lane) const {
        const int64_t i = leaf * leaf_size + lane;
        return i < int64_t(face_->size()) ? (*face_)[i] : -1;
    }

    // Calls found(leaf) for all leaves from `first` on that overlap the box, in their order.
    template <class Found>
    void each_leaf(const FaceBox& box, int64_t first, Found found) const {
        if (levels_.size() == 1) {
            if (first == 0) found(int64_t(0));
            return;
        }
        visit(int(levels_.size()) - 1, 0, box, first, found);
    }

    static int64_t bytes(int64_t faces) {
        return faces * int64_t(sizeof(int32_t) + (sizeof(BoxGroup) * 8 / 7 + sizeof(CornerGroup)) / BoxGroup::size);
    }

   private:
    void make_boxes(const int32_t* faces, const double* verts, Team& team);
    double spread() const;

    // Group i of a level holds the boxes of groups 8 i … 8 i + 7 of the one below.
    template <class Found>
    void visit(int level, int64_t i, const FaceBox& box, int64_t first, Found& found) const {
        const BoxGroup& group = levels_[level][i];
        const int64_t span = int64_t(1) << 3 * (level - 1);  // leaves in one of its boxes
        for (unsigned hits = group.overlapping(box); hits; hits &= hits - 1) {
            const int64_t child = BoxGroup::size * i + std::countr_zero(hits);
            if ((child + 1) * span <= first) continue;
            if (level == 1) found(child);
            else visit(level - 1, child, box, first, found);
        }
    }

    const std::vector<int32_t>* face_ = nullptr;
    Array<CornerGroup> corners_{0};        // of each leaf
    std::vector<Array<BoxGroup>> levels_;  // of faces, of leaves, …, the last one of one group
};

}  // namespace edgegrad
