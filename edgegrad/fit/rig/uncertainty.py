"""How exactly pictures show what a fit of a rig sought, joint by joint, and how likely the fit is right.

With the loss L = Σ ρ(r_p) over pixels p, its curvature H = Σ w_p J_p J_pᵀ and the score s_p = w_p r_p J_p of each, the
numbers have the covariance H⁻¹ (Σ s_p s_pᵀ) H⁻¹ (Huber, The Behavior of Maximum Likelihood Estimates under Nonstandard
Conditions, 1967; White, A Heteroskedasticity-Consistent Covariance Matrix Estimator, 1980). It needs no noise level, since
residuals show it pixel by pixel. It is local: it does not know of other poses that match the pictures as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..descent.curvature import scores
from ..descent.objective import Objective
from ..logistic import Logistic
from .joint_support import SUPPORT_STEPS, places_of
from .settings import RIG

# By `python -m benchmarks.rig_confidence --train --count 350`.
RIG_CONFIDENCE = Logistic(
    names=("support", "residual", "deviation"),
    weights=(0.4907, -2.3461, -3.3842),
    bias=-1.3662,
    mean=(0.962, 0.6404, 0.2849),
    deviation=(0.1483, 0.8012, 0.9344),
)


@dataclass(frozen=True, eq=False)
class JointUncertainty:
    """Standard deviations of what was sought, where the pictures' pixels are off by chance and the rig is right.

    Attributes
    ----------
    covariance : (n, n) float64, of all numbers that were sought, in the order of the fit's values
    degrees : by the joint's name, of its rotation about the axis about which it is known least; of a robot of its angle
    axes : by the joint's name, this axis (3,), among its own, of length 1; none of a robot
    """

    covariance: Tensor
    degrees: dict[str, float]
    axes: dict[str, Tensor]

    @property
    def unknown(self) -> str:
        """Return the joints that are known less exactly than to 5°, in words, the worst first; empty where there are none."""
        worst = sorted(
            (name for name, d in self.degrees.items() if d > RIG.known_degrees), key=lambda name: -self.degrees[name]
        )
        return ", ".join(f"{name} known to ±{self.degrees[name]:.0f}°{self._about(name)} only" for name in worst)

    def _about(self, name: str) -> str:
        return (
            f" about ({', '.join(f'{x:.1f}' for x in (self.axes[name] + 0.0).tolist())})" if name in self.axes else ""
        )


def uncertainty_of(
    objective: Objective,
    tensors: Mapping[str, Tensor],
    rates: Mapping[str, float],
    joints: Mapping[str, tuple[str, ...]],
) -> JointUncertainty:
    """Return the uncertainty at these values.

    rates   of each value, of which 1 / RIG.rotation_rate make as much as a radian does
    joints  names of joints, by the values that are their rotations
    """
    H, S = scores(objective, tensors, SUPPORT_STEPS[0])
    units = {name: rates[name] / RIG.rotation_rate for name in tensors}
    unit = torch.cat([torch.full((v.numel(),), units[name], dtype=torch.float64) for name, v in tensors.items()])
    H, S = H * unit * unit[:, None], S * unit * unit[:, None]
    # The prior is one more picture, of the pixels' own noise, that shows all to RIG.prior_deviation.
    noise = float(S.diagonal().sum() / H.diagonal().sum().clamp(min=1e-300))
    inverse = torch.linalg.pinv(
        H + noise / RIG.prior_deviation**2 * torch.eye(len(H), dtype=torch.float64), hermitian=True
    )
    known = S + noise**2 / RIG.prior_deviation**2 * torch.eye(len(H), dtype=torch.float64)
    covariance = inverse @ known @ inverse
    covariance = covariance * unit * unit[:, None]
    degrees: dict[str, float] = {}
    axes: dict[str, Tensor] = {}
    for joint, place in places_of(tensors, joints).items():
        size, directions = torch.linalg.eigh(covariance[place, place])
        degrees[joint] = math.degrees(math.sqrt(max(float(size[-1]), 0.0)))
        if len(size) == 3:
            axes[joint] = directions[:, -1] * float(directions[directions[:, -1].abs().argmax(), -1].sign())
    return JointUncertainty(covariance, degrees, axes)


def features_of(support: Mapping[str, float], uncertainty: JointUncertainty, residual: float) -> dict[str, float]:
    """Return the features. `support` and `residual`, the loss over the noise of its samples, are those of the last pose."""
    return {
        "support": min(support.values(), default=0.0),  # share of edges, of the joint that shows the smallest
        "residual": math.log10(max(residual, 0.1)),
        "deviation": math.log10(max(uncertainty.degrees.values(), default=180.0) + 1e-3),  # degrees, of the worst joint
    }
