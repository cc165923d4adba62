// Where a surface is a height field it cannot pass through itself, and nothing else passes through it there.
//
// Take a prism with a parallelogram as its base, and all faces that touch it. If (1) each of them faces along the
// prism, (2) none reaches its top or bottom, (3) they have no border, so that every edge has a face on both sides, and
// (4) one line along the prism meets one face, then each line does: over the base the number of faces met is a degree,
// the same everywhere, and none of them counts against another. Two faces that pass through each other would be met by
// the same lines. So no face in the prism needs to be compared with any other. (Volino and Magnenat-Thalmann 1994 ask
// instead whether the outline of a patch crosses itself.)
//
// Prisms are laid around the nodes of a tree, and where one fails around its leaves. Smooth surfaces pass but for where
// something else is near; then pairs of faces are compared.
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

    // Whether any face passes through those of the leaf, as far as this tells.
    bool crossed(int64_t leaf) const { return by_[leaf] != Crossed::by_none; }
    // The surface whose faces do not, to be left out (FaceTree::each_leaf); −1: none.
    int32_t but(int64_t leaf) const { return by_[leaf] == Crossed::by_any ? -1 : tree_->surface(leaf); }
    // Whether a face of the one may pass through one of the other.
    bool crossed(int64_t leaf, int64_t other) const { return crossed_by(leaf, other) && crossed_by(other, leaf); }

   private:
    class Search;
    enum class Crossed : uint8_t { by_any, by_others, by_none };  // by faces of other surfaces

    bool crossed_by(int64_t leaf, int64_t other) const {
        return by_[leaf] == Crossed::by_any ||
               (by_[leaf] == Crossed::by_others && tree_->surface(leaf) != tree_->surface(other));
    }

    const FaceTree* tree_;
    std::vector<Crossed> by_;
};

}  // namespace edgegrad
