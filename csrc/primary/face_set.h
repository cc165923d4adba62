// FaceSet is a set of faces that is cleared in constant time: hash slots store the round that filled them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/sampler.h"

namespace edgegrad {

class FaceSet {
   public:
    void clear() { ++round_, size_ = 0; }

    // Returns false if the face is in the set already.
    bool insert(int32_t face) {
        if (2 * size_ >= slots_.size()) grow();
        const bool inserted = insert_into(slots_, face);
        size_ += inserted;
        return inserted;
    }

   private:
    struct Slot {
        int32_t face = -1;
        uint32_t round = 0;  // the slot is free if the round is an earlier one
    };

    bool insert_into(std::vector<Slot>& slots, int32_t face) const {
        for (size_t i = mix(uint64_t(face));; ++i) {
            Slot& slot = slots[i & (slots.size() - 1)];
            if (slot.round == round_ && slot.face == face) return false;
            if (slot.round == round_) continue;
            slot = {face, round_};
            return true;
        }
    }

    void grow() {
        std::vector<Slot> larger(2 * slots_.size());
        for (const Slot& slot : slots_)
            if (slot.round == round_) insert_into(larger, slot.face);
        slots_.swap(larger);
    }

    std::vector<Slot> slots_ = std::vector<Slot>(32);
    size_t size_ = 0;
    uint32_t round_ = 1;
};

}  // namespace edgegrad
