"""How likely a tracked pose is right: features of an update, and the map from them to a probability."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ..fit.logistic import Logistic
from ..kernel.tracking import Found

RIGHT = 5.0, 0.05  # degrees and share of the object's size within which a tracked pose is right

TRACK_CONFIDENCE = Logistic(
    names=("edges", "deviation", "visible", "residual", "gain", "texture"),
    weights=(4.5966, -4.5506, 0.0537, -2.4535, -0.6888, 0.3411),
    bias=-0.5754,
    mean=(0.5537, -0.7342, 0.9238, 1.372, 9.8202, 0.703),
    deviation=(0.3733, 0.5584, 0.2653, 0.8146, 7.3963, 0.3445),
)


def features_of(found: Found, textured: bool) -> dict[str, float]:
    """Return the features of an update of one object, by name."""
    kernel, variance = found.features, np.diag(found.covariance)
    degrees, shift = math.degrees(math.sqrt(max(variance[:3].sum(), 0.0))), math.sqrt(max(variance[3:].sum(), 0.0))
    off = max(degrees / RIGHT[0], shift / RIGHT[1])
    return {
        "edges": kernel["edges"],  # share of the lines that show an edge close to the contour
        "deviation": math.log10(min(max(off, 1e-3), 1e2)),  # standard deviation, relative to what is right
        "visible": kernel["visible"],
        "residual": kernel["residual"],
        "gain": kernel["gain"],
        # Without a texture, the lines' share stands for that of the texture's points that are explained.
        "texture": kernel["texture"] if textured else kernel["edges"],
    }


def confidence_of(features: Mapping[str, float]) -> float:
    """Return the probability that a pose with these features is right."""
    return TRACK_CONFIDENCE.probability(features)
