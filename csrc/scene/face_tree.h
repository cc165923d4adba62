// Boxes of faces in a tree, to find which of them overlap.
//
// Faces are sorted along a space-filling curve (Morton 1966), large surfaces one after the other; eight in a row are a
// leaf, eight leaves in a row a node, and so on. The order is kept while the faces move, as long as it is nearly as
// good as when it was made; boxes are made anew.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <vector>

#include "core/array.h"
#include "core/math.h"
#include "core/parallel.h"
#include "scene/topology.h"

namespace edgegrad {

// An order of faces in which neighbours lie near one another.
struct FaceOrder {
    std::vector<int32_t> face;
    double spread = 0;  // mean size of a leaf's box relative to that of all, when it was made
};

struct FaceBox {
    float low[3], high[3];

    FaceBox with(const FaceBox& o) const {
        FaceBox all;
        for (int k = 0; k < 3; ++k) all.low[k] = std::min(low[k], o.low[k]), all.high[k] = std::max(high[k], o.high[k]);
        return all;
    }
};

// A box that lies askew: those p for which axis[k] · (p − middle) is at most half[k].
struct AskewBox {
    float middle[3], axis[3][3], half[3];
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
    // … may overlap this one: what no face of it separates from box i.
    unsigned overlapping(const AskewBox& box) const;
};

// The plane of a face as its neighbours are compared with it.
struct FacePlane {
    const int32_t* vertex;  // 3, of the face
    Vec3 origin, normal;
    double normal_length;
    double coordinate;  // the largest of the face's coordinates
};

// The corners of eight faces, relative to one of them, so that floats hold them well.
struct CornerGroup {
    static constexpr int size = BoxGroup::size;
    Vec3 origin;
    float reach;              // the largest of the numbers in p
    float p[3][3][size];      // by corner and axis
    int32_t vertex[3][size];  // −1: there is no face

    // Bit i: face i shares at most one vertex with a face, and its others lie neither all before the plane of that face
    // nor all behind it, to the precision of floats, and by more than what touches may lie apart (contact.h) where no
    // mesh is coarser than `spacing`. Of most neighbours this says all.
    unsigned may_cross(const FacePlane& plane, double spacing) const;
};

class FaceTree {
   public:
    static constexpr int leaf_size = BoxGroup::size;

    // At these positions (V, 3). Makes the order where there is none, or one that fits no more.
    FaceTree(const int32_t* faces, int64_t n_faces, const double* verts, const Topology& topology, FaceOrder& order,
             ThreadTeam& team);

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

    // The surface (Topology) that all faces of a leaf belong to; −1: they are of several.
    int32_t surface(int64_t leaf) const { return surface_[0][leaf]; }
    // … of the leaves first … first + span − 1, where `span` is a power of eight and `first` a multiple of it.
    int32_t surface(int64_t first, int64_t span) const {
        size_t level = 0;
        for (; span > 1 && level + 1 < surface_.size(); span /= BoxGroup::size) first /= BoxGroup::size, ++level;
        return surface_[level][first];
    }

    // Calls found(leaf) for all leaves from `first` on that overlap the box, in their order, until it is false. Those
    // of the surface `but`, if it is not −1, are left out.
    template <class Box, class Found>
    void each_leaf(const Box& box, int64_t first, int32_t but, Found found) const {
        if (levels_.size() > 1) visit(int(levels_.size()) - 1, 0, box, first, but, found);
        else if (first == 0 && (but < 0 || surface(0) != but)) found(int64_t(0));
    }

    static int64_t bytes(int64_t faces) {
        return faces *
               int64_t(sizeof(int32_t) +
                       (sizeof(BoxGroup) * 8 / 7 + sizeof(CornerGroup) + sizeof(int32_t) * 8 / 7) / BoxGroup::size);
    }

   private:
    void make_boxes(const int32_t* faces, const double* verts, ThreadTeam& team);
    void find_surfaces(const Topology& topology, ThreadTeam& team);
    double spread() const;

    // Group i of a level holds the boxes of groups 8 i … 8 i + 7 of the one below.
    template <class Box, class Found>
    bool visit(int level, int64_t i, const Box& box, int64_t first, int32_t but, Found& found) const {
        const BoxGroup& group = levels_[level][i];
        const int64_t span = int64_t(1) << 3 * (level - 1);  // leaves in one of its boxes
        for (unsigned hits = group.overlapping(box); hits; hits &= hits - 1) {
            const int64_t child = BoxGroup::size * i + std::countr_zero(hits);
            if ((child + 1) * span <= first || (but >= 0 && surface_[level - 1][child] == but)) continue;
            if (!(level == 1 ? found(child) : visit(level - 1, child, box, first, but, found))) return false;
        }
        return true;
    }

    const std::vector<int32_t>* face_ = nullptr;
    Array<CornerGroup> corners_{0};        // of each leaf
    std::vector<Array<BoxGroup>> levels_;  // of faces, of leaves, …, the last one of one group
    std::vector<Array<int32_t>> surface_;  // of leaves, of groups of leaves, …
};

}  // namespace edgegrad
