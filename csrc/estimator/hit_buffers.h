// What the image says to the backward pass.
#pragma once

#include <cstdint>

namespace edgegrad {

// What the image pass hit, for the backward pass.
template <class T>
struct HitBuffers {
    T* coverage = nullptr;    // (H, W): the filtered share of each pixel where something is hit
    float* depth = nullptr;   // (H, W): nothing that samples hit lies farther away; infinite where one hit nothing
    int32_t* hit = nullptr;   // (H, W, 2): the first and the last of the faces hit, as the scene counts them; −1: none
    uint8_t* seen = nullptr;  // (F,): 0, or the side, 1 or 2, from which a sample hit the face
};

}  // namespace edgegrad
