// Dispatches to code compiled for the common numbers of channels, or for any number.
#pragma once

namespace edgegrad {

// N > 0 means N channels, all of radiance. N < 0 means −N channels, with attributes (shading/attributes.h). 0 means any
// number.
template <int N>
inline constexpr int all_channels = N < 0 ? -N : N;
template <int N>
inline constexpr int radiance_channels = N < 0 ? 0 : N;  // 0 means unknown.

// Returns f.template operator()<N>() for the N that code is compiled for.
template <class F>
auto dispatch_channels(int channels, bool attributes, F f) {
    if (attributes) return channels == 4 ? f.template operator()<-4>() : f.template operator()<0>();
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

}  // namespace edgegrad
