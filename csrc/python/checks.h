// Views Python arrays without a copy, and raises errors that name the position of bad values.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <functional>
#include <string>

namespace edgegrad {

namespace nb = nanobind;

template <class T, int Dimensions>
using In = nb::ndarray<const T, nb::numpy, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;
template <class T, int Dimensions>
using Out = nb::ndarray<T, nb::numpy, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;

// Throws what becomes a ValueError.
[[noreturn]] void refuse(const std::string& text);

// Returns a position in rows of this width, as Python writes it.
std::string at(int64_t index, int64_t width);

// Returns whether all blocks of the numbers first … last − 1 pass. It uses threads where they save more than they cost.
bool all_pass(int64_t n, int threads, const std::function<bool(int64_t first, int64_t last)>& pass);

// Rejects values beyond the largest float, and NaN, in float or double arrays. Squares and products of larger ones
// would leave the range of doubles.
template <class T>
void check_finite(const char* name, const T* values, int64_t n, int64_t width, int threads);
template <class T>
bool all_finite(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, int threads);

// Returns whether all are from 0 to count − 1, for int32_t or int64_t.
template <class T>
bool all_below(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, T count, int threads);

// Checks `n` indices in rows of three; the first one has the index `first`.
void check_indices(const char* name, const int32_t* values, int64_t n, int64_t count, const char* of, int threads,
                   int64_t first = 0);

}  // namespace edgegrad
