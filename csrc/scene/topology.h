// Edges on welded positions with all their faces.
//
// Whether two faces share an edge is a matter of position, not of index: a file that splits vertices at its seams, or a
// soup of triangles, has borders by index where the surface has none. So vertices on borders by index are welded where
// they coincide. Indices alone decide inside, so a closed mesh pays nothing for this.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "scene/scene.h"

namespace edgegrad {

// A face at an edge: the face, and which of its sides (corner i to corner i + 1) lies on the edge.
struct HalfEdge {
    int32_t face;
    int8_t corner;   // of the face, where the side begins
    bool backwards;  // against the direction of the edge, which is that of its first half-edge

    int first() const { return backwards ? (corner + 1) % 3 : corner; }   // corner of the face at the edge's start
    int second() const { return backwards ? corner : (corner + 1) % 3; }  // … and at its end
};

// Which faces hang together: those that share a vertex by index, and all that share one with them.
class Parts {
   public:
    Parts(const int32_t* faces, int64_t n_faces, int64_t n_verts, ThreadTeam& team);

    int64_t size() const { return size_; }
    // The part of a face, by one of its vertices.
    int32_t of(int32_t vertex) const { return part_[vertex]; }
    // That of all faces in a block (ThreadTeam::parallel_for_blocks); −1: they are of several.
    int32_t of_block(int64_t block) const { return of_block_[block]; }

   private:
    std::vector<int32_t> part_, of_block_;
    int32_t size_ = 0;
};

class Topology {
   public:
    Topology(const int32_t* faces, int64_t n_faces, int64_t n_verts, ThreadTeam& team);

    // Welds what coincides at these positions (V, 3).
    void weld(const double* verts, const Spacing& spacing, ThreadTeam& team);

    // Whether vertices were welded.
    bool welds() const { return !welded_.empty(); }

    int64_t n_edges() const { return int64_t(offset_.size()) - 1; }
    std::span<const HalfEdge> half_edges(int64_t edge) const {
        return {half_edge_.data() + offset_[edge], half_edge_.data() + offset_[edge + 1]};
    }
    // The faces of an edge, for a ray that must not see them.
    std::span<const int32_t> faces(int64_t edge) const {
        return {face_.data() + offset_[edge], face_.data() + offset_[edge + 1]};
    }

    // Whether an edge has two faces, which run along it in opposite directions, as where a surface goes on.
    bool joins_two(int64_t edge) const { return joins_two_[edge]; }

    // Whether all edges of a face do.
    bool goes_on(int32_t face) const { return goes_on_[face]; }
    // The connected surface that a face belongs to, across such edges, by one of its faces.
    int32_t surface(int32_t face) const { return surface_[face]; }

    // Of so many faces and edges.
    static int64_t bytes(int64_t faces, int64_t edges) {
        return 3 * faces * int64_t(sizeof(HalfEdge) + sizeof(int32_t)) + edges * int64_t(sizeof(int64_t) + 1);
    }

    // Asks for what the half-edges will be looked up by.
    void prefetch(int64_t edge) const { edgegrad::prefetch(&offset_[edge]); }

   private:
    void build(ThreadTeam& team);

    const int32_t* faces_;
    int64_t n_faces_, n_verts_;
    std::vector<int32_t> welded_;      // for each vertex the first one at its place; empty: every vertex is its own
    std::vector<int32_t> candidates_;  // vertices on borders by index
    std::vector<int64_t> offset_;
    std::vector<HalfEdge> half_edge_;
    std::vector<int32_t> face_;
    std::vector<uint8_t> joins_two_;  // by edge
    std::vector<uint8_t> goes_on_;    // by face
    std::vector<int32_t> surface_;    // by face
};

}  // namespace edgegrad
