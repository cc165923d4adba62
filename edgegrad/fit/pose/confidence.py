"""How likely a pose is right: features of the fit, and the map from them to a probability."""

from __future__ import annotations

import math

from ..logistic import Logistic
from .likelihood.support import Evidence
from .uncertainty import Uncertainty

RIGHT = 2.0, 0.02  # degrees and share of the object's size within which a pose is right

# By the training of `make calibrate`, of 150 fits, which are fewer than it draws, of meshes made there and of twelve files.
POSE_CONFIDENCE = Logistic(
    names=("doubt", "support", "deviation", "visible", "gain", "resolution"),
    weights=(-0.9153, 0.6464, -0.8044, -0.5185, 0.589, -0.0993),
    bias=1.7537,
    mean=(-2.5254, 0.867, -0.4175, 0.8817, -0.0926, 7.2449),
    deviation=(0.9859, 0.1676, 0.3176, 0.1309, 0.3649, 0.3029),
)


def features_of(evidence: Evidence, probability: float, known: Uncertainty) -> dict[str, float]:
    """Return the features of a pose, of this probability among modes."""
    off = max(known.degrees / RIGHT[0], known.shift / known.size / RIGHT[1])
    return {
        "doubt": math.log10(1.0 - probability + 1e-3),  # of other modes, by the posterior's mass
        "support": evidence.edges,
        "deviation": math.log10(min(max(off, 1e-3), 1e2)),  # standard deviation, relative to what is right
        "visible": evidence.visible,
        "gain": math.log10(max(evidence.nats, 1e-3)),
        "resolution": math.log2(evidence.across),
    }
