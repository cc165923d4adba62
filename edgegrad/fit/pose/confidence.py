"""How likely a pose is right: features of the fit, and the map from them to a probability."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..logistic import Logistic
from .likelihood.support import Evidence
from .uncertainty import Uncertainty

RIGHT = 2.0, 0.02  # degrees and share of the object's size within which a pose is right

# By the training of `make calibrate`, of 183 fits to seeds below 120, which are fewer than it draws, of meshes made there and of
# nine files. It is the probability that the pose is right if it is of the right mode.
POSE_CONFIDENCE = Logistic(
    names=("support", "deviation", "visible", "gain", "resolution"),
    weights=(0.8007, -1.3438, -0.1997, 0.0903, 0.1743),
    bias=2.2172,
    mean=(0.9115, -0.6427, 0.8883, -0.0153, 7.277),
    deviation=(0.1144, 0.4029, 0.1119, 0.3069, 0.3553),
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
