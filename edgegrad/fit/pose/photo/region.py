"""The region term: the object is where the colours are that it has, beside those that lie around it.

Of a pixel x whose colour is p_f as frequent inside the silhouette, near x, and p_b outside of it, the posterior that it shows the
object is P = p_f / (p_f + p_b). A render covers the share α of it, so the likelihood is f = α P + (1 − α)(1 − P), and the loss
−Σ log f (Prisacariu and Reid, PWP3D, 2012). Colours are counted near each pixel, for those of the whole picture seldom tell an
object from what surrounds it (Tjaden et al., A Region-Based Gauss-Newton Approach, 2017).

The gradient is −Σ (2P − 1)/f ∇α, with P held fixed, and the curvature is Σ of the squares of the same, Fisher's information.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..gauss_newton import Normal
from .picture import Windows, smoothed

LEAST = 1e-4  # frequency of any colour
OUTLIERS = 1e-3  # likelihood of pixels that tell nothing


def posterior(windows: Windows, alpha: Tensor, near: Tensor) -> Tensor:
    """(h, w), of the colours as the silhouette alpha (h, w) divides them; `near` (h, w) counts what surrounds the object."""
    inside, outside = windows.frequencies(alpha * near), windows.frequencies((1.0 - alpha) * near)
    return (inside + LEAST) / (inside + outside + 2.0 * LEAST)


def region_term(posterior: Tensor, alpha: Tensor, tangents: Tensor, near: Tensor, sigma: float) -> tuple[Normal, float]:
    """The equations of alpha (h, w) with its derivatives (n, h, w), both blurred by `sigma` pixels, which widens the reach of a
    step, and the mean loss of a pixel; `near` (h, w) counts what surrounds the object."""
    return regions_term(torch.stack([posterior, 1.0 - posterior]), alpha[None], tangents[:, None], near, sigma)


def posteriors(windows: Sequence[Windows], alphas: Tensor, near: Tensor) -> Tensor:
    """(N + 1, h, w) of N objects with the silhouettes alphas (N, h, w), and last of what lies behind them, in windows of each."""
    shares = torch.cat([alphas, (1.0 - alphas.sum(0, keepdim=True)).clamp(min=0.0)]) * near
    counted = [one.frequencies(share) * one.present(share) for one, share in zip(windows, shares, strict=True)]
    likely = torch.stack(counted) + LEAST
    return likely / likely.sum(0)


def regions_term(
    posteriors: Tensor, alphas: Tensor, tangents: Tensor, near: Tensor, sigma: float
) -> tuple[Normal, float]:
    """As region_term(), of N objects that may cover one another: posteriors (N + 1, h, w), alphas (N, h, w), and their
    derivatives (n, N, h, w). A pixel has the likelihood Σ αₖ Pₖ, with what lies behind them as the last region (Schmaltz et al.,
    Region-Based Pose Tracking with Occlusions Using 3D Models, 2012)."""
    soft = smoothed(alphas, sigma)
    *objects, behind = posteriors
    more = torch.stack(objects) - behind
    likelihood = behind + (soft * more).sum(0) + OUTLIERS
    slope = -more / likelihood * near
    blurred = smoothed(tangents.flatten(0, 1), sigma).reshape(tangents.shape).double()
    weighted = (blurred * slope).sum(1).flatten(1)
    loss = -float((near * likelihood.log()).sum()) / max(float(near.sum()), 1e-30)
    return Normal(weighted @ weighted.T, weighted.sum(1)), loss
