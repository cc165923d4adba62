// Finds edges on welded positions with all their faces.
//
// Whether two faces share an edge depends on position, not on index. A file that splits vertices at seams, or a soup of
// triangles, has borders by index where the surface has none. Vertices on borders by index are therefore welded where
// they coincide. Inside, indices alone decide, so a closed mesh costs nothing extra.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "scene/scene.h"

namespace edgegrad {

// Holds a face at an edge, and which of its sides (corner i to corner i + 1) lies on the edge.
struct HalfEdge {
    int32_t face;
    int8_t corner;   // face's corner where the side begins
    bool backwards;  // relative to the edge's direction, that of its first half-edge

    // It is the face's corner at the edge's start.
    int first() const { return backwards ? (corner + 1) % 3 : corner; }
    int second() const { return backwards ? corner : (corner + 1) % 3; }  // It is the face's corner at the edge's end.
};

// Groups faces into connected parts: faces that share vertices by index, directly or through others.
class ConnectedParts {
   public:
    ConnectedParts(const int32_t* faces, int64_t n_faces, int64_t n_verts, ThreadTeam& team);

    int64_t size() const { return size_; }
    // Returns the part of a face, by one of its vertices.
    int32_t of(int32_t vertex) const { return part_[vertex]; }
    // Returns the part of all faces in a block (ThreadTeam::parallel_for_blocks), or −1 if they belong to several.
    int32_t of_block(int64_t block) const { return of_block_[block]; }

   private:
    std::vector<int32_t> part_, of_block_;
    int32_t size_ = 0;
};

class Topology {
   public:
    Topology(const int32_t* faces, int64_t n_faces, int64_t n_verts, ThreadTeam& team);

    // Welds coincident vertices at the positions (V, 3).
    void weld(const double* verts, const Spacing& spacing, ThreadTeam& team);

    // Returns whether vertices were welded.
    bool welds() const { return !welded_.empty(); }

    int64_t n_edges() const { return int64_t(offset_.size()) - 1; }
    std::span<const HalfEdge> half_edges(int64_t edge) const {
        return {half_edge_.data() + offset_[edge], half_edge_.data() + offset_[edge + 1]};
    }
    // Returns the faces of an edge, for a ray that must not see them.
    std::span<const int32_t> faces(int64_t edge) const {
        return {face_.data() + offset_[edge], face_.data() + offset_[edge + 1]};
    }

    // Returns whether an edge has two faces that run along it in opposite directions, as on a continuous surface.
    bool joins_two(int64_t edge) const { return joins_two_[edge]; }

    // Returns whether all edges of a face join two faces.
    bool has_all_neighbours(int32_t face) const { return has_all_neighbours_[face]; }
    // Returns the connected surface of a face, across such edges, named by one of its faces.
    int32_t surface(int32_t face) const { return surface_[face]; }

    // Bounds the memory for these numbers of faces and edges.
    static int64_t bytes(int64_t faces, int64_t edges) {
        return 3 * faces * int64_t(sizeof(HalfEdge) + sizeof(int32_t)) + edges * int64_t(sizeof(int64_t) + 1);
    }

    // Prefetches the index of the half-edges.
    void prefetch(int64_t edge) const { edgegrad::prefetch(&offset_[edge]); }

   private:
    void build(ThreadTeam& team);

    const int32_t* faces_;
    int64_t n_faces_, n_verts_;
    // It maps each vertex to the first one at its position; if empty, vertices are distinct.
    std::vector<int32_t> welded_;
    std::vector<int32_t> candidates_;  // vertices on borders by index
    std::vector<int64_t> offset_;
    std::vector<HalfEdge> half_edge_;
    std::vector<int32_t> face_;
    std::vector<uint8_t> joins_two_;           // indexed by edge
    std::vector<uint8_t> has_all_neighbours_;  // indexed by face
    std::vector<int32_t> surface_;             // indexed by face
};

}  // namespace edgegrad
