// Arrays of Python as views without a copy, and what the kernel refuses in them, as errors that name the place.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <limits>
#include <string>
#include <type_traits>

#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

namespace nb = nanobind;

template <class T, int Dimensions>
using In = nb::ndarray<const T, nb::numpy, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;
template <class T, int Dimensions>
using Out = nb::ndarray<T, nb::numpy, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;

[[noreturn]] inline void refuse(const std::string& text) { throw nb::value_error(text.c_str()); }

inline std::string at(int64_t index, int64_t width) {
    return width == 1 ? "[" + std::to_string(index) + "]"
                      : "[" + std::to_string(index / width) + ", " + std::to_string(index % width) + "]";
}

inline std::string text(double number) {
    char out[32];
    std::snprintf(out, sizeof out, "%g", number);
    return out;
}

// Looks at blocks of numbers, on several threads where these save more than they cost: whether all pass.
template <class T, class Pass>
bool all_pass(const T* values, int64_t n, int threads, Pass pass) {
    constexpr int64_t block = 1 << 16, parallel_from = 1 << 18;
    if (n <= parallel_from) return pass(values, n);
    std::atomic<bool> all{true};
    Team(threads).each((n + block - 1) / block, [&](int64_t k) {
        if (all && !pass(values + k * block, std::min(block, n - k * block))) all = false;
    });
    return all;
}

// What leaves the range of floats is refused too: the squares and products of such numbers would leave that of doubles.
template <class T>
constexpr T largest = T(std::numeric_limits<float>::max());

// Whether all are numbers up to the largest. Several counts, for one would wait for each addition.
constexpr int counts = 16;
template <class T>
EDGEGRAD_VECTORIZED bool are_finite(const T* values, int64_t n) {
    T bad[counts] = {};
    int64_t i = 0;
    for (; i + counts <= n; i += counts)
        for (int k = 0; k < counts; ++k) bad[k] += std::fabs(values[i + k]) <= largest<T> ? T(0) : T(1);
    for (; i < n; ++i) bad[0] += std::fabs(values[i]) <= largest<T> ? T(0) : T(1);
    for (int k = 1; k < counts; ++k) bad[0] += bad[k];
    return bad[0] == 0;
}

template <class T>
void check_finite(const char* name, const T* values, int64_t n, int64_t width, int threads) {
    if (all_pass(values, n, threads, are_finite<T>)) return;
    for (int64_t i = 0; i < n; ++i)
        if (!(std::fabs(values[i]) <= largest<T>))
            refuse(std::string(name) + ": expected " +
                   (std::isfinite(values[i]) ? "numbers up to 3.4e38" : "finite numbers") + ", got " + text(values[i]) +
                   " at " + at(i, width));
}

// Whether all are from 0 to count − 1: else one of v and count − 1 − v has its sign bit set.
template <class T>
EDGEGRAD_VECTORIZED bool are_below(const T* values, int64_t n, T count) {
    using U = std::make_unsigned_t<T>;
    U signs = 0;
    for (int64_t i = 0; i < n; ++i) signs |= U(values[i]) | (U(count) - 1 - U(values[i]));
    return T(signs) >= 0;
}

template <class T>
bool all_below(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, T count, int threads) {
    return all_pass(array.data(), array.size(), threads, [=](const T* v, int64_t n) { return are_below(v, n, count); });
}

template <class T>
bool all_finite(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, int threads) {
    return all_pass(array.data(), array.size(), threads, are_finite<T>);
}

// `n` indices, in rows of three, of which the first is number `first`.
inline void check_indices(const char* name, const int32_t* values, int64_t n, int64_t count, const char* of,
                          int threads, int64_t first = 0) {
    if (all_pass(values, n, threads, [=](const int32_t* v, int64_t m) { return are_below(v, m, int32_t(count)); }))
        return;
    for (int64_t i = 0; i < n; ++i)
        if (values[i] < 0 || values[i] >= count)
            refuse(std::string(name) + ": expected indices from 0 to " + std::to_string(count - 1) + " (rows of " + of +
                   "), got " + std::to_string(values[i]) + " at " + at(first + i, 3));
}

}  // namespace edgegrad
