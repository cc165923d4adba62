"""How likely a fit of a rig is right: features of the fit, and the map from them to a probability."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..logistic import Logistic
from .uncertainty import JointUncertainty

# By `python -m benchmarks.rig_confidence --train --count 350`.
RIG_CONFIDENCE = Logistic(
    names=("support", "residual", "deviation"),
    weights=(0.4907, -2.3461, -3.3842),
    bias=-1.3662,
    mean=(0.962, 0.6404, 0.2849),
    deviation=(0.1483, 0.8012, 0.9344),
)


def features_of(support: Mapping[str, float], uncertainty: JointUncertainty, residual: float) -> dict[str, float]:
    """Return the features. `support` and `residual`, the loss over the noise of its samples, are those of the last pose."""
    return {
        "support": min(support.values(), default=0.0),  # share of edges, of the joint that shows the smallest
        "residual": math.log10(max(residual, 0.1)),
        "deviation": math.log10(max(uncertainty.degrees.values(), default=180.0) + 1e-3),  # degrees, of the worst joint
    }
