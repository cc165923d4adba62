// Generates sample points without state, as a function of seed, stream and index, so that no thread keeps a generator.
#pragma once

#include <bit>
#include <cstdint>

#include "core/math.h"

namespace edgegrad {

// Mixes bits bijectively, by the finaliser of splitmix64 (Steele, Lea and Flood 2014).
inline uint64_t mix(uint64_t x) {
    x ^= x >> 30, x *= 0xbf58476d1ce4e5b9ull;
    x ^= x >> 27, x *= 0x94d049bb133111ebull;
    return x ^ (x >> 31);
}

// Hashes two fixed numbers with many third ones.
class Hash {
   public:
    Hash(uint64_t seed, uint64_t a) : before_(mix(mix(seed + odd) + a + odd)) {}
    uint64_t operator()(uint64_t b) const { return mix(before_ + b + odd); }

   private:
    static constexpr uint64_t odd = 0x9e3779b97f4a7c15ull;
    uint64_t before_;
};
inline uint64_t hash(uint64_t seed, uint64_t a, uint64_t b = 0) { return Hash(seed, a)(b); }

// Separates the hashes of the gradient's samples from those of the image's pixels, as their third argument.
constexpr uint64_t gradient_stream = 1;

// Numbers of random sequences, one for each quantity that the gradient draws. Estimates that share one are correlated.
enum class Stream : uint64_t {
    surface_faces = 1,
    surface_points = 2,
    surface_pixels = 4,
    surface_pixel_choice = 5,
    primary_curves = 3,
    intersections = 12,
    discontinuity_columns = 6,
    discontinuity_rows = 24,
    discontinuities = 7,
    shadow_light_parts = 8,
    shadow_rays = 9,
    shadow_pilots = 10,
    shadow_places = 11,
    shadow_alpha_edges = 13,
    shadow_alpha_light_parts = 25,
    indirect_shadow_rays = 26,
    indirect_shadow_pilots = 27,
    indirect_shadow_places = 28,
    edge_line_places = 14,
    edge_line_paths = 15,
    edge_lines = 16,
    edge_line_pilot_places = 17,
    edge_line_pilots = 18,
    edge_line_pilot_paths = 19,
    edge_line_alpha_edges = 29,
    surface_edge_intersections = 20,
    surface_edge_places = 21,
    surface_edge_rays = 22,
    surface_edge_paths = 23,
    surface_edge_alpha_edges = 30,
};

inline uint64_t seed_of(uint64_t seed, Stream stream) { return hash(seed, uint64_t(stream), gradient_stream); }

// Returns the middle of one of 2⁵² equal cells of (0, 1). The bits become the fraction of a number between 1 and 2.
inline double to_unit(uint64_t bits) {
    return std::bit_cast<double>(bits >> 12 | 0x3ff0000000000000ull) - (1 - 0x1p-53);
}

// Generates n points in the unit square: the golden-ratio lattice (i / n, i φ⁻¹) moved by a random shift (Cranley and
// Patterson 1976). Each point is uniform by itself, so any mean over them is unbiased.
class ShiftedLattice {
   public:
    explicit ShiftedLattice(int n) : step_(~0ull / n) {}

    // Writes points first … first + n − 1 of the lattice that `random` shifts.
    void fill(uint64_t random, int first, int n, double* x, double* y) const {
        uint64_t a = random + first * step_, b = mix(random) + first * golden;
        for (int i = 0; i < n; ++i, a += step_, b += golden) x[i] = to_unit(a), y[i] = to_unit(b);
    }

   private:
    static constexpr uint64_t golden = 0x9e3779b97f4a7c15;
    uint64_t step_;
};

// Generates a sequence whose runs of consecutive points are all spread evenly: i (1/p, 1/p²) with p³ = p + 1 (Roberts
// 2018, "R2"), moved by a random shift.
class ShiftedSequence {
   public:
    explicit ShiftedSequence(uint64_t random) : x_(random), y_(mix(random)) {}
    Vec2 operator()(uint64_t i) const {
        return {to_unit(x_ + i * 0xc13fa9a902a6328full), to_unit(y_ + i * 0x91e10da5c79e7b1dull)};
    }

   private:
    uint64_t x_, y_;
};

}  // namespace edgegrad
