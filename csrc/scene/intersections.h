// Where faces pass through each other, of all meshes and of each with itself.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "scene/face_tree.h"
#include "scene/height_field.h"
#include "scene/scene.h"
#include "scene/topology.h"

namespace edgegrad {

struct Intersection {
    int32_t face[2];  // ascending
    // Where the surface passes through a face exactly along an edge: face[next to] ends there, and `next` goes on on
    // the other side. Moved one way, the one passes through, moved the other way, the other; so each counts half.
    int32_t next = -1;
    int32_t ending = 0;
    // The share of the gradient that goes to these two: copies of faces in the same place have the same segment. More
    // than 1 where they stand for others that were not drawn.
    double weight = 1;
    Vec3 a, b;  // the ends of the segment that both share, in the world
};

// Faces (F, 3) at positions (V, 3), with the edges there.
struct PlacedFaces {
    const int32_t* faces;
    int64_t n_faces;
    const double* verts;
    const Spacing& spacing;
    const Topology& topology;
};

class Intersections {
   public:
    // Finds all of them, if they are few. `order` is kept from time to time.
    Intersections(const PlacedFaces& faces, FaceOrder& order, ThreadTeam& team);
    Intersections(const Intersections&) = delete;  // the tree points to its order

    // A tangle of noise, or a soup of large triangles, has so many that finding them all would take longer than all
    // else, and most of them are hidden. So each view draws its own, at random.
    bool are_drawn() const { return tree_ != nullptr; }

    // By ascending faces, if they are not drawn.
    const Array<Intersection>& all() const { return all_; }

    // Those of drawn faces with one another, by ascending faces. The face f is drawn with the probability share[f]; and
    // where there still would be too many, only some pairs of leaves are.
    Array<Intersection> drawn(const PlacedFaces& faces, const Array<float>& share, uint64_t seed,
                              ThreadTeam& team) const;

    // Of so many that are found among so many faces, before and after they are sorted, what they are sorted by, and
    // what they are drawn by. Lists double as they grow.
    static int64_t bytes(int64_t found, int64_t faces) {
        return found * int64_t(3 * sizeof(Intersection) + sizeof(uint64_t)) +
               faces * int64_t(sizeof(uint32_t) + 2 * sizeof(float) + sizeof(uint8_t));
    }

   private:
    // Two faces that pass through each other, and for how many such pairs they stand.
    struct Pair {
        int32_t face[2];
        double stands_for;
    };
    std::vector<Pair> some_pairs(const PlacedFaces& faces, ThreadTeam& team) const;

    Array<Intersection> all_{0};
    // To draw from; null where all were found.
    FaceOrder order_;
    std::unique_ptr<FaceTree> tree_;
    std::unique_ptr<HeightFields> fields_;
    std::vector<Pair> pilot_;
    Array<float> copies_{0};  // (F,): 1 over how many copies of a face there are
};

}  // namespace edgegrad
