#include "python/checks.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <limits>
#include <type_traits>

#include "core/math.h"
#include "core/parallel.h"

namespace edgegrad {

void refuse(const std::string& text) { throw nb::value_error(text.c_str()); }

std::string at(int64_t index, int64_t width) {
    return width == 1 ? "[" + std::to_string(index) + "]"
                      : "[" + std::to_string(index / width) + ", " + std::to_string(index % width) + "]";
}

bool all_pass(int64_t n, int threads, const std::function<bool(int64_t, int64_t)>& pass) {
    constexpr int64_t block = 1 << 16, parallel_from = 1 << 18;
    if (n <= parallel_from) return pass(0, n);
    std::atomic<bool> all{true};
    ThreadTeam(threads).parallel_for((n + block - 1) / block, [&](int64_t k) {
        if (all && !pass(k * block, std::min(n, (k + 1) * block))) all = false;
    });
    return all;
}

namespace {

std::string text(double number) {
    char out[32];
    std::snprintf(out, sizeof out, "%g", number);
    return out;
}

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

// Whether all are from 0 to count − 1: else one of v and count − 1 − v has its sign bit set.
template <class T>
EDGEGRAD_VECTORIZED bool are_below(const T* values, int64_t n, T count) {
    using U = std::make_unsigned_t<T>;
    U signs = 0;
    for (int64_t i = 0; i < n; ++i) signs |= U(values[i]) | (U(count) - 1 - U(values[i]));
    return T(signs) >= 0;
}

}  // namespace

template <class T>
void check_finite(const char* name, const T* values, int64_t n, int64_t width, int threads) {
    if (all_pass(n, threads, [&](int64_t i, int64_t end) { return are_finite(values + i, end - i); })) return;
    for (int64_t i = 0; i < n; ++i)
        if (!(std::fabs(values[i]) <= largest<T>))
            refuse(std::string(name) + ": expected " +
                   (std::isfinite(values[i]) ? "numbers up to 3.4e38" : "finite numbers") + ", got " + text(values[i]) +
                   " at " + at(i, width));
}

template <class T>
bool all_finite(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, int threads) {
    const T* values = array.data();
    return all_pass(array.size(), threads,
                    [=](int64_t first, int64_t last) { return are_finite(values + first, last - first); });
}

template <class T>
bool all_below(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, T count, int threads) {
    const T* values = array.data();
    return all_pass(array.size(), threads,
                    [=](int64_t first, int64_t last) { return are_below(values + first, last - first, count); });
}

void check_indices(const char* name, const int32_t* values, int64_t n, int64_t count, const char* of, int threads,
                   int64_t first) {
    if (all_pass(n, threads, [&](int64_t i, int64_t end) { return are_below(values + i, end - i, int32_t(count)); }))
        return;
    for (int64_t i = 0; i < n; ++i)
        if (values[i] < 0 || values[i] >= count)
            refuse(std::string(name) + ": expected indices from 0 to " + std::to_string(count - 1) + " (rows of " + of +
                   "), got " + std::to_string(values[i]) + " at " + at(first + i, 3));
}

template void check_finite(const char*, const float*, int64_t, int64_t, int);
template void check_finite(const char*, const double*, int64_t, int64_t, int);
template bool all_finite(nb::ndarray<const float, nb::numpy, nb::c_contig, nb::device::cpu>, int);
template bool all_finite(nb::ndarray<const double, nb::numpy, nb::c_contig, nb::device::cpu>, int);
template bool all_below(nb::ndarray<const int32_t, nb::numpy, nb::c_contig, nb::device::cpu>, int32_t, int);
template bool all_below(nb::ndarray<const int64_t, nb::numpy, nb::c_contig, nb::device::cpu>, int64_t, int);

}  // namespace edgegrad
