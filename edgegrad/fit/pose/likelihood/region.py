"""The region term: the object is where the colours are that are frequent inside its silhouette and rare around it.

A pixel's colour has the frequency p_f among pixels inside the silhouette nearby, p_b among those outside, and p among all of
them. A render covers the share α of the pixel, so its likelihood is α p_f + (1 − α) p_b (Prisacariu and Reid, PWP3D, 2012;
windows: Tjaden et al., A Region-Based Gauss-Newton Approach, 2017). The cost is −Σ log of its ratio to p, which is that of a
picture without the object. Frequencies are counted anew at each pose, which maximises the likelihood over them: with few
pixels a window knows little, and has the whole picture's colours as a prior.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ...region import CELLS, MIN_FREQUENCY, Windows, smoothed
from ..settings import POSE
from .picture import PictureLevel, RenderedPoses
from .term import Term


class Frequencies(NamedTuple):
    """The frequencies of pixels' colours nearby, (N, h, w)."""

    inside: Tensor
    outside: Tensor
    every: Tensor  # (1, h, w), the same for any silhouette

    @staticmethod
    def from_picture(picture: PictureLevel, alpha: Tensor) -> Frequencies:
        """Count the colours as silhouettes alpha (N, h, w) of the whole picture divide them."""
        if picture.mask is not None:
            inside = picture.mask.expand_as(alpha)
            return Frequencies(inside, 1.0 - inside, torch.full_like(alpha[:1], 0.5))
        (N, h, w), colors = alpha.shape, picture.palette.colors
        cell = max(1.0, POSE.window_radius * picture.extent / CELLS)
        rows, columns = ((torch.arange(n, dtype=torch.float32) / cell).long() for n in (h, w))
        shape, count = (math.ceil(h / cell), math.ceil(w / cell)), len(colors)
        cells = shape[0] * shape[1]
        index = picture.labels * cells + (rows[:, None] * shape[1] + columns).flatten()
        similar = torch.exp(-0.5 * (torch.cdist(colors, colors) / Windows.COLOUR_SIGMA).square())
        similar = (similar / similar.sum(1, keepdim=True)).T
        whole = torch.zeros(count, dtype=torch.float32).index_add_(0, picture.labels, picture.weight.flatten())
        prior = POSE.prior_pixels * (similar @ whole)[:, None] / whole.sum().clamp(min=1e-30)
        shares = torch.cat([alpha * picture.weight, (1.0 - alpha) * picture.weight]).flatten(1)
        counted = torch.zeros(2 * N, count * cells, dtype=torch.float32).index_add_(1, index, shares)
        windows = smoothed((similar @ counted.reshape(2 * N, count, cells)).reshape(-1, *shape), Windows.WIDTH)
        inside, outside = windows.reshape(2, N, count, cells)

        def frequency(window: Tensor) -> Tensor:
            found = (window + prior) / (window.sum(1, keepdim=True) + POSE.prior_pixels)
            return found.flatten(1)[:, index].reshape(-1, h, w) + MIN_FREQUENCY

        return Frequencies(frequency(inside), frequency(outside), frequency((inside + outside)[:1]))


def region_term(
    picture: PictureLevel, seen: RenderedPoses, colors: Frequencies, visible: Tensor, sigma: float
) -> Term:  # fmt: skip
    """Return the term of N silhouettes, with alpha blurred by `sigma` pixels; `visible` (N, h, w) weights the pixels of the
    renders' box."""
    away = (colors.outside / colors.every).log() * picture.weight
    far = away.sum((1, 2)) - seen.box.cut(away).sum((1, 2))
    inside, outside, every = (seen.box.cut(one) for one in colors)
    weight = seen.box.cut(picture.weight) * visible
    soft = smoothed(seen.alpha, sigma)
    likelihood = soft * inside + (1.0 - soft) * outside + POSE.region_outliers * (inside + outside)
    cost = -far - (weight * (likelihood / every).log()).sum((1, 2))
    slope = ((outside - inside) / likelihood * weight).flatten(1)
    blurred = smoothed(seen.tangents.flatten(0, 1), sigma).reshape(seen.tangents.shape).flatten(2).movedim(0, 1)
    rows = (blurred * slope[:, None]).double()  # Sums of many large numbers of both signs need more digits.
    return Term(cost.double(), rows.sum(-1), rows @ rows.mT)
