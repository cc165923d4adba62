"""How likely a pose is right: features of the fit, and the map from them to a probability."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..logistic import Logistic
from .likelihood.support import Evidence
from .uncertainty import Uncertainty

RIGHT = 2.0, 0.02  # degrees and share of the object's size within which a pose is right

# By the training of `make calibrate`, of 133 fits to seeds below 120, which are fewer than it draws, of meshes made there and of
# nine files. It is the probability that the pose is right if it is of the right mode.
POSE_CONFIDENCE = Logistic(
    names=("support", "deviation", "visible", "gain", "resolution"),
    weights=(0.5634, -1.1246, -0.0771, 0.0623, 0.1843),
    bias=1.9921,
    mean=(0.9093, -0.6291, 0.8823, -0.0177, 7.2613),
    deviation=(0.1237, 0.3971, 0.1119, 0.3199, 0.3618),
)
FEATURES = ("mass", *POSE_CONFIDENCE.names)


def confidence_of(features: Mapping[str, float]) -> float:
    """Return the probability that a pose with these features is right."""
    return features["mass"] * POSE_CONFIDENCE.probability(features)


def features_of(evidence: Evidence, probability: float, known: Uncertainty) -> dict[str, float]:
    """Return the features of a pose, of this probability among modes."""
    off = max(known.degrees / RIGHT[0], known.shift / known.size / RIGHT[1])
    return {
        "mass": probability,  # of the posterior about this mode
        "support": evidence.edges,
        "deviation": math.log10(min(max(off, 1e-3), 1e2)),  # standard deviation, relative to what is right
        "visible": evidence.visible,
        "gain": math.log10(max(evidence.nats, 1e-3)),
        "resolution": math.log2(evidence.across),
    }
