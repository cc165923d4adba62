"""The region term as the equations of a step."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...region import MIN_FREQUENCY, OUTLIERS, Windows, smoothed
from ..gauss_newton import NormalEquations


def region_term(
    posterior: Tensor, alpha: Tensor, tangents: Tensor, near: Tensor, sigma: float
) -> tuple[NormalEquations, float]:
    """Return the equations of alpha (h, w) with its derivatives (n, h, w), and the mean loss of a pixel. Both are blurred by
    `sigma` pixels, which widens the reach of a step; `near` (h, w) weights what surrounds the object."""
    return regions_term(torch.stack([posterior, 1.0 - posterior]), alpha[None], tangents[:, None], near, sigma)


def posteriors(windows: Sequence[Windows], alphas: Tensor, near: Tensor) -> Tensor:
    """Return the posteriors (N + 1, h, w) of N objects with the silhouettes alphas (N, h, w), and last of the background, in
    windows of each."""
    shares = torch.cat([alphas, (1.0 - alphas.sum(0, keepdim=True)).clamp(min=0.0)]) * near
    counted = [one.frequencies(share) * one.present(share) for one, share in zip(windows, shares, strict=True)]
    likely = torch.stack(counted) + MIN_FREQUENCY
    return likely / likely.sum(0)


def regions_term(
    posteriors: Tensor, alphas: Tensor, tangents: Tensor, near: Tensor, sigma: float
) -> tuple[NormalEquations, float]:
    """Return what region_term() does for N objects that may cover one another. posteriors (N + 1, h, w), alphas (N, h, w), and
    their derivatives (n, N, h, w). A pixel has the likelihood Σ αₖ Pₖ, with the background as the last region (Schmaltz et
    al., Region-Based Pose Tracking with Occlusions Using 3D Models, 2012)."""
    soft = smoothed(alphas, sigma)
    *objects, behind = posteriors
    more = torch.stack(objects) - behind
    likelihood = behind + (soft * more).sum(0) + OUTLIERS
    slope = -more / likelihood * near
    blurred = smoothed(tangents.flatten(0, 1), sigma).reshape(tangents.shape).double()
    weighted = (blurred * slope).sum(1).flatten(1)
    loss = -float((near * likelihood.log()).sum()) / max(float(near.sum()), 1e-30)
    return NormalEquations(weighted @ weighted.T, weighted.sum(1)), loss
