// Finds where faces pass through each other, among all meshes and within each.
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
    // A surface may pass through a face exactly along an edge: face[ending] ends there, and `next` continues on the
    // other side. Motion one way lets one of them pass through, motion the other way the other; each counts half.
    int32_t next = -1;
    int32_t ending = 0;
    // The fraction of the gradient that goes to this pair, because copies of faces have the same segment. It exceeds 1
    // if the pair also represents others that were not drawn.
    double weight = 1;
    Vec3 a, b;  // ends of the shared segment, in the world
};

// Holds faces (F, 3) at positions (V, 3), with their edges.
struct PlacedFaces {
    const int32_t* faces;
    int64_t n_faces;
    const double* verts;
    const Spacing& spacing;
    const Topology& topology;
};

class Intersections {
   public:
    // Finds all intersections, if they are few. `order` persists between calls.
    Intersections(const PlacedFaces& faces, FaceOrder& order, ThreadTeam& team);
    Intersections(const Intersections&) = delete;  // The tree points to its order.

    // A noisy tangle, or a soup of large triangles, has so many intersections that finding all would take longer than
    // everything else. Most of them are hidden, so each view draws its own sample.
    bool are_drawn() const { return tree_ != nullptr; }

    // Returns all, sorted by faces, if they are not drawn.
    const Array<Intersection>& all() const { return all_; }

    // Returns the intersections of drawn faces with one another, sorted by faces. Face f is drawn with the probability
    // share[f]. If there would still be too many, only some pairs of leaves are drawn.
    Array<Intersection> drawn(const PlacedFaces& faces, const Array<float>& share, uint64_t seed,
                              ThreadTeam& team) const;

    // Bounds the memory for these numbers of intersections and faces: both lists before and after sorting, the sort
    // keys, and the probabilities. Lists double as they grow.
    static int64_t bytes(int64_t found, int64_t faces) {
        return found * int64_t(3 * sizeof(Intersection) + sizeof(uint64_t)) +
               faces * int64_t(sizeof(uint32_t) + 2 * sizeof(float) + sizeof(uint8_t));
    }

   private:
    // Holds two faces that pass through each other, and how many such pairs they represent.
    struct IntersectingPair {
        int32_t face[2];
        double stands_for;
    };
    std::vector<IntersectingPair> some_pairs(const PlacedFaces& faces, ThreadTeam& team) const;

    Array<Intersection> all_{0};
    // These serve drawing; they are null where all were found.
    FaceOrder order_;
    std::unique_ptr<FaceTree> tree_;
    std::unique_ptr<HeightFields> fields_;
    std::vector<IntersectingPair> pilot_;
    Array<float> copies_{0};  // (F,) 1 over the number of copies of a face
};

}  // namespace edgegrad
