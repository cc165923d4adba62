// Proves that parts of surfaces have no intersections, because a height field cannot pass through itself.
//
// Take a prism with a parallelogram as its base, and all faces that touch it. Assume that (1) each of them faces along
// the prism, and (2) none reaches its top or bottom. Assume that (3) every edge has a face on both sides, so there is
// no border. Assume that (4) one line along the prism hits one face. Then each such line does. The number of faces hit
// over the base is a degree, the same everywhere, and no face counts against another. Two faces that pass through each
// other would be hit by the same lines. No face in the prism thus needs a comparison with any other. (Volino and
// Magnenat-Thalmann 1994 test instead whether the outline of a patch crosses itself.)
//
// Prisms surround the nodes of a tree, and where one fails, its leaves. Smooth surfaces pass unless something else is
// near; pairs of faces are compared there.
#pragma once

#include <cstdint>
#include <vector>

#include "core/parallel.h"
#include "scene/face_tree.h"
#include "scene/topology.h"

namespace edgegrad {

class HeightFields {
   public:
    HeightFields(const FaceTree& tree, const Topology& topology, ThreadTeam& team);

    // Returns whether some face may pass through those of the leaf.
    bool crossed(int64_t leaf) const { return by_[leaf] != Crossed::by_none; }
    // Returns the surface that does not pass through them, which FaceTree::each_leaf may skip; −1: none.
    int32_t but(int64_t leaf) const { return by_[leaf] == Crossed::by_any ? -1 : tree_->surface(leaf); }
    // Returns whether a face of one leaf may pass through one of the other.
    bool crossed(int64_t leaf, int64_t other) const { return crossed_by(leaf, other) && crossed_by(other, leaf); }

   private:
    class Search;
    enum class Crossed : uint8_t { by_any, by_others, by_none };  // `by_others` means by faces of other surfaces.

    bool crossed_by(int64_t leaf, int64_t other) const {
        return by_[leaf] == Crossed::by_any ||
               (by_[leaf] == Crossed::by_others && tree_->surface(leaf) != tree_->surface(other));
    }

    const FaceTree* tree_;
    std::vector<Crossed> by_;
};

}  // namespace edgegrad
