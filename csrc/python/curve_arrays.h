// Hands records of samples on curves to Python.
#pragma once

#include <nanobind/nanobind.h>

#include <vector>

#include "accumulate/records.h"

namespace edgegrad {

namespace nb = nanobind;

// Returns the fields of CurveRecords in edgegrad/points/records.py. Barycentrics are at least `least`. `one` selects
// the first point of each sample (curve_hits.h).
nb::dict curve_arrays(const std::vector<CurveRecords>& parts, double least, bool one, int threads);

}  // namespace edgegrad
