// Records of samples on curves, handed to Python.
#pragma once

#include <nanobind/nanobind.h>

#include <vector>

#include "accumulate/records.h"

namespace edgegrad {

namespace nb = nanobind;

// The fields of CurveRecords in edgegrad/points/records.py. Barycentrics are no less than `least`; `one`: of each
// sample the first point alone (curve_hits.h).
nb::dict curve_arrays(const std::vector<CurveRecords>& parts, double least, bool one, int threads);

}  // namespace edgegrad
