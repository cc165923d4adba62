"""Probabilities by logistic regression: the calibrated map from a few named features to how likely an answer is right."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple


class Logistic(NamedTuple):
    """σ(bias + Σ weight · (feature − mean) / deviation), with σ(x) = 1 / (1 + e⁻ˣ)."""

    names: tuple[str, ...]
    weights: tuple[float, ...]
    bias: float
    mean: tuple[float, ...]
    deviation: tuple[float, ...]

    def probability(self, features: Mapping[str, float]) -> float:
        """Return the probability, 0 … 1, at features of these names."""
        columns = zip(self.names, self.weights, self.mean, self.deviation, strict=True)
        x = self.bias + sum(w * (features[name] - mean) / deviation for name, w, mean, deviation in columns)
        return 1.0 / (1.0 + math.exp(-min(max(x, -700.0), 700.0)))
