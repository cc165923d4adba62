// Hands results to Python.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <type_traits>
#include <utility>
#include <vector>

namespace edgegrad {

namespace nb = nanobind;

// Returns a vector or an Array as an array of this shape, without a copy.
template <class Values>
nb::object shaped(Values&& values, const std::vector<size_t>& shape) {
    static_assert(!std::is_reference_v<Values>);  // Values are moved from.
    using X = std::remove_pointer_t<decltype(values.data())>;
    auto* kept = new Values(std::move(values));
    const nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<Values*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, X>(kept->data(), shape.size(), shape.data(), owner));
}

// Returns it as rows of this shape.
template <class Values>
nb::object rows(Values&& values, std::vector<size_t> row = {}) {
    size_t width = 1;
    for (const size_t n : row) width *= n;
    row.insert(row.begin(), size_t(values.size()) / width);
    return shaped(std::forward<Values>(values), row);
}

}  // namespace edgegrad
