// Holds a bounding volume hierarchy of faces, to find overlapping ones.
//
// Faces are sorted along a space-filling curve (Morton 1966), large surfaces one after the other. Eight consecutive
// faces are a leaf, eight leaves a node, and so on. The order persists while the faces move, as long as it is nearly as
// good as initially. Boxes are always recomputed.
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

// Orders faces so that neighbours are close in space.
struct FaceOrder {
    std::vector<int32_t> face;
    double spread = 0;  // mean size of a leaf's box relative to the box of all when the order was made
};

struct FaceBox {
    float low[3], high[3];

    FaceBox with(const FaceBox& o) const {
        FaceBox all;
        for (int k = 0; k < 3; ++k) all.low[k] = std::min(low[k], o.low[k]), all.high[k] = std::max(high[k], o.high[k]);
        return all;
    }
};

// An oriented box contains the points p for which |axis[k] · (p − middle)| is at most half[k].
struct OrientedBox {
    float middle[3], axis[3][3], half[3];
};

// Holds eight boxes in lanes. Missing ones are empty.
struct BoxGroup {
    static constexpr int size = 8;
    float low[3][size], high[3][size];

    void set(int lane, const FaceBox& box);
    FaceBox box(int lane) const;
    FaceBox bounds() const;

    // Returns a mask whose bit i says that box i overlaps this one.
    unsigned overlapping(const FaceBox& box) const;
    // Returns a mask of boxes that may overlap this one: no face of the oriented box separates them.
    unsigned overlapping(const OrientedBox& box) const;
};

// Holds the plane of a face for comparison with its neighbours.
struct FacePlane {
    const int32_t* vertex;  // 3 vertices of the face
    Vec3 origin, normal;
    double normal_length;
    double coordinate;  // largest of the face's coordinates
};

// Holds the corners of eight faces relative to one of them, so that floats represent them well.
struct CornerGroup {
    static constexpr int size = BoxGroup::size;
    Vec3 origin;
    float reach;              // largest of the numbers in p
    float p[3][3][size];      // Indices are corner and axis.
    int32_t vertex[3][size];  // −1 means that there is no face.

    // Returns a mask of faces that may cross a plane's face. Face i shares at most one vertex with it, and its others
    // lie neither all before the plane nor all behind it. Floats decide, with the margin of touching faces (contact.h)
    // where no mesh is coarser than `spacing`. This rejects most neighbours.
    unsigned may_cross(const FacePlane& plane, double spacing) const;
};

class FaceTree {
   public:
    static constexpr int leaf_size = BoxGroup::size;

    // Builds the tree at the positions (V, 3). Makes an order if there is none, or the old one no longer fits.
    FaceTree(const int32_t* faces, int64_t n_faces, const double* verts, const Topology& topology, FaceOrder& order,
             ThreadTeam& team);

    int64_t n_leaves() const { return levels_[0].size(); }
    const BoxGroup& leaf(int64_t i) const { return levels_[0][i]; }
    FaceBox bounds(int64_t leaf) const {
        return levels_.size() == 1 ? levels_[0][0].bounds()
                                   : levels_[1][leaf / BoxGroup::size].box(int(leaf % BoxGroup::size));
    }
    const CornerGroup& corners(int64_t leaf) const { return corners_[leaf]; }
    // Returns the face at a leaf and lane, −1: none.
    int32_t face(int64_t leaf, int lane) const {
        const int64_t i = leaf * leaf_size + lane;
        return i < int64_t(face_->size()) ? (*face_)[i] : -1;
    }

    // Returns the surface (Topology) of all faces of a leaf, or −1 if they belong to several.
    int32_t surface(int64_t leaf) const { return surface_[0][leaf]; }
    // Does the same for the leaves first … first + span − 1; `span` is a power of eight and divides `first`.
    int32_t surface(int64_t first, int64_t span) const {
        size_t level = 0;
        for (; span > 1 && level + 1 < surface_.size(); span /= BoxGroup::size) first /= BoxGroup::size, ++level;
        return surface_[level][first];
    }

    // Calls found(leaf) in order for all leaves from `first` on that overlap the box, until it returns false. Leaves of
    // the surface `but` are skipped unless it is −1.
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

    // Group i of a level holds the boxes of groups 8 i … 8 i + 7 of the level below.
    template <class Box, class Found>
    bool visit(int level, int64_t i, const Box& box, int64_t first, int32_t but, Found& found) const {
        const BoxGroup& group = levels_[level][i];
        const int64_t span = int64_t(1) << 3 * (level - 1);  // number of leaves in one of the group's boxes
        for (unsigned hits = group.overlapping(box); hits; hits &= hits - 1) {
            const int64_t child = BoxGroup::size * i + std::countr_zero(hits);
            if ((child + 1) * span <= first || (but >= 0 && surface_[level - 1][child] == but)) continue;
            if (!(level == 1 ? found(child) : visit(level - 1, child, box, first, but, found))) return false;
        }
        return true;
    }

    const std::vector<int32_t>* face_ = nullptr;
    Array<CornerGroup> corners_{0};        // Each leaf has a group.
    std::vector<Array<BoxGroup>> levels_;  // groups of faces, of leaves, …; the last level has one group
    std::vector<Array<int32_t>> surface_;  // surfaces of leaves, of groups of leaves, ….
};

}  // namespace edgegrad
