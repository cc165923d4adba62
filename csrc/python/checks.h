// Arrays of Python as views without a copy, and what the kernel refuses in them, as errors that name the place.
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

// A place in rows of this width, as Python writes it.
std::string at(int64_t index, int64_t width);

// Checks blocks of the numbers first … last − 1, on several threads where these save more than they cost: whether all
// pass.
bool all_pass(int64_t n, int threads, const std::function<bool(int64_t first, int64_t last)>& pass);

// Refuses all but numbers up to the largest float, of float or double: squares and products of larger ones would leave
// the range of doubles.
template <class T>
void check_finite(const char* name, const T* values, int64_t n, int64_t width, int threads);
template <class T>
bool all_finite(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, int threads);

// Whether all are from 0 to count − 1; of int32_t or int64_t.
template <class T>
bool all_below(nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu> array, T count, int threads);

// `n` indices, in rows of three, of which the first is number `first`.
void check_indices(const char* name, const int32_t* values, int64_t n, int64_t count, const char* of, int threads,
                   int64_t first = 0);

}  // namespace edgegrad
