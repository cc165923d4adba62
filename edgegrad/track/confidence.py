"""How likely a tracked pose is right: features of an update, and the map from them to a probability."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ..fit.logistic import Logistic
from ..kernel.tracking import Found

RIGHT = 5.0, 0.05  # degrees and share of the object's size within which a tracked pose is right

# By `python -m benchmarks.track --train`, of 1,400 frames of 14 films, seeds 1 and 2: textured and plain objects, hands, motion
# blur, white before white, and objects that are covered whole.
TRACK_CONFIDENCE = Logistic(
    names=("deviation", "edges", "gain", "residual", "texture"),
    weights=(-2.7526, 1.0712, 0.0149, -1.0225, -0.1556),
    bias=2.8671,
    mean=(-0.9639, 0.7919, 14.9185, 1.1437, 0.6976),
    deviation=(0.4011, 0.2387, 4.7657, 0.5373, 0.379),
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
