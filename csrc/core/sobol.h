// Generates scrambled Sobol points in the plane, which pixels share so that neighbours' samples complement each other.
//
// The points form a (0,2)-sequence (Sobol 1967). Every run of consecutive points that begins at a multiple of its
// length 2^m is stratified: each box 2^−a × 2^(a−m) of the unit square gets equally many. Pixels in the order of a
// space-filling curve take consecutive runs. The samples of one pixel are then spread evenly, and so are the offsets in
// blocks of 2 × 2, 4 × 4, … pixels (Ahmed and Wonka 2020, "Screen-space blue-noise diffusion of Monte Carlo sampling
// error via hierarchical ordering of pixels"). Neighbouring pixels find what one pixel misses.
#pragma once

#include <cstdint>

#include "core/math.h"
#include "core/sampler.h"

namespace edgegrad {

inline uint32_t reversed_bits(uint32_t x) {
    x = (x >> 1 & 0x55555555u) | (x & 0x55555555u) << 1;
    x = (x >> 2 & 0x33333333u) | (x & 0x33333333u) << 2;
    x = (x >> 4 & 0x0f0f0f0fu) | (x & 0x0f0f0f0fu) << 4;
    x = (x >> 8 & 0x00ff00ffu) | (x & 0x00ff00ffu) << 8;
    return x >> 16 | x << 16;
}

// Moves bit c of x to bit 2 c.
inline uint64_t spread_bits(uint32_t x) {
    uint64_t s = x;
    s = (s | s << 16) & 0x0000ffff0000ffffull;
    s = (s | s << 8) & 0x00ff00ff00ff00ffull;
    s = (s | s << 4) & 0x0f0f0f0f0f0f0f0full;
    s = (s | s << 2) & 0x3333333333333333ull;
    return (s | s << 1) & 0x5555555555555555ull;
}

// Returns the position of a pixel on the Z-order curve (Morton 1966), which alternates the bits of x and y.
inline uint64_t z_order(uint32_t x, uint32_t y) { return spread_bits(x) | spread_bits(y) << 1; }

class ScrambledSobol {
   public:
    explicit ScrambledSobol(uint64_t random) : x_(random), y_(mix(random)) {}

    // Writes points first … first + n − 1. They repeat after 2³².
    void fill(uint64_t first, int n, double* x, double* y) const {
        for (int k = 0; k < n; ++k) {
            const Vec2 point = (*this)(uint32_t(first) + k);
            x[k] = point.x, y[k] = point.y;
        }
    }
    Vec2 operator()(uint32_t i) const { return {unit(x_(i)), unit(y_(pascal(i)))}; }

   private:
    friend class ShuffledSobol;
    // Both coordinates store the first binary digit in the lowest bit. In this form, the first coordinate is i itself.

    // Returns the second coordinate. Its digit r is the sum of the digits c of i for which the binomial C(c, r) is odd.
    // These are the c whose bits contain the bits of r.
    static uint32_t pascal(uint32_t i) {
        i ^= (i & 0xaaaaaaaau) >> 1;
        i ^= (i & 0xccccccccu) >> 2;
        i ^= (i & 0xf0f0f0f0u) >> 4;
        i ^= (i & 0xff00ff00u) >> 8;
        return i ^ i >> 16;
    }
    // Applies Owen's scrambling: a hash of the digits before it decides whether each digit is flipped. This keeps the
    // boxes' counts and makes each point uniform. Sums and products carry only from low bits to high ones, so they are
    // such hashes (Laine and Karras 2011; constants by Vegdahl 2021).
    struct Scramble {
        explicit Scramble(uint64_t random) : shift(uint32_t(random)), factor(uint32_t(random >> 32) | 1) {}
        uint32_t operator()(uint32_t x) const {
            x ^= x * 0x3d20adeau;
            x += shift;
            x *= factor;
            x ^= x * 0x05526c56u;
            return x ^ x * 0x53a22864u;
        }
        uint32_t shift, factor;
    };
    static double unit(uint32_t x) { return to_unit(uint64_t(reversed_bits(x)) << 32 | 1u << 31); }

    Scramble x_, y_;
};

// Generates the same points in another order, which keeps together runs that begin at a multiple of their length 2^m
// (Burley 2020, "Practical hash-based Owen scrambling"). Several sequences of the same i are thereby independent.
class ShuffledSobol {
   public:
    explicit ShuffledSobol(uint64_t random) : points_(random), order_(mix(random + 1)) {}
    Vec2 operator()(uint32_t i) const { return points_(reversed_bits(order_(reversed_bits(i)))); }

   private:
    ScrambledSobol points_;
    ScrambledSobol::Scramble order_;
};

}  // namespace edgegrad
