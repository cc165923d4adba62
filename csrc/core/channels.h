// Code is compiled for the numbers of channels that matter, and once more for any number.
#pragma once

namespace edgegrad {

// Calls f.template operator()<N>() with N = C where code for a fixed number of channels is compiled, else with 0.
template <class F>
void dispatch_channels(int channels, F f) {
    switch (channels) {
        case 1:
            return f.template operator()<1>();
        case 3:
            return f.template operator()<3>();
        case 4:
            return f.template operator()<4>();
        default:
            return f.template operator()<0>();
    }
}

// Of those numbers, for explicit instantiations.
#define EDGEGRAD_FOR_CHANNELS(X) X(0) X(1) X(3) X(4)

}  // namespace edgegrad
