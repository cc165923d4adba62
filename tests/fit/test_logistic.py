"""Logistic regressions, by which fits say how likely they are right."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.poses.logistic import left_out, trained
from benchmarks.poses.summary import bins, calibration_error
from edgegrad.fit.logistic import Logistic

pytestmark = pytest.mark.quick


def test_a_map_is_found_from_its_outcomes() -> None:
    g = np.random.default_rng(0)
    cases = [{"a": float(a), "b": float(b), "same": 1.0} for a, b in g.normal(2.0, 3.0, (4000, 2))]
    truth = [1.0 / (1.0 + math.exp(-(0.5 + 0.8 * case["a"] - 0.4 * case["b"]))) for case in cases]
    right = [bool(x < p) for x, p in zip(g.random(4000), truth, strict=True)]
    found = trained(cases, right)
    said = [found.probability(case) for case in cases]
    assert sum(abs(p - q) for p, q in zip(said, truth, strict=True)) / 4000 < 0.02

    def error(said: list[float]) -> float:
        return calibration_error(bins(list(zip(said, right, strict=True))))

    assert error(left_out(cases[:500], right[:500], [k % 5 for k in range(500)]) + said[500:]) < 0.05
    assert error(said) < 0.03 < 0.15 < error([0.99] * 4000)


def test_features_far_from_all_cases() -> None:
    known = Logistic(("a",), (2.0,), 0.0, (0.0,), (1e-6,))
    assert known.probability({"a": 1e6, "b": 0.0}) == 1.0 and known.probability({"a": -1e6}) < 1e-300
