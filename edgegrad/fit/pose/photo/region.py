"""The region term as the equations of a step."""

from __future__ import annotations

from torch import Tensor

from ...region import likelihood, slope, smoothed
from ..gauss_newton import Normal


def region_term(posterior: Tensor, alpha: Tensor, tangents: Tensor, near: Tensor, sigma: float) -> tuple[Normal, float]:
    """The equations of alpha (h, w) with its derivatives (n, h, w), both blurred by `sigma` pixels, which widens the reach of a
    step, and the mean loss of a pixel; `near` (h, w) counts what surrounds the object."""
    soft = smoothed(alpha[None], sigma)[0]
    J = smoothed(tangents, sigma).flatten(1).double()
    weighted = J * (slope(posterior, soft) * near).flatten()
    loss = -float((near * likelihood(posterior, soft).log()).sum()) / max(float(near.sum()), 1e-30)
    return Normal(weighted @ weighted.T, weighted.sum(1)), loss
