// HitBuffers passes the hits of the forward pass to the backward pass.
#pragma once

#include <cstdint>

namespace edgegrad {

template <class T>
struct HitBuffers {
    T* coverage = nullptr;    // (H, W): filtered fraction of each pixel with a hit
    float* depth = nullptr;   // (H, W): an upper bound of the depths of hits; infinite where a sample missed
    int32_t* hit = nullptr;   // (H, W, 2): first and last face hit, numbered as in the scene; −1: none
    uint8_t* seen = nullptr;  // (F,): 0, or the side, 1 or 2, from which a sample hit the face
};

}  // namespace edgegrad
