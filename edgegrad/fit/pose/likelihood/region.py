"""The region term: the object is where the colours are that are frequent inside its silhouette and rare around it.

A pixel's colour has the frequency p_f among pixels inside the silhouette nearby, p_b among those outside, and p among all of
them. A render covers the share α of the pixel, so its likelihood is α p_f + (1 − α) p_b (Prisacariu and Reid, PWP3D, 2012;
windows: Tjaden et al., A Region-Based Gauss-Newton Approach, 2017). The cost is −Σ log of its ratio to p, which is that of a
picture without the object. Frequencies are counted anew at each pose, which maximises the likelihood over them: with few
pixels a window knows little, and has the whole picture's colours as a prior.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...region import ColorFrequencies, smoothed
from ..settings import POSE
from .picture import PictureLevel, RenderedPoses
from .term import Term


class Frequencies(ColorFrequencies):
    """The frequencies of pixels' colours nearby, (N, h, w); of masks those of the two sides."""

    @staticmethod
    def from_picture(picture: PictureLevel, alpha: Tensor) -> Frequencies:
        """Count the colours as silhouettes alpha (N, h, w) of the whole picture divide them."""
        if picture.mask is not None:
            inside = picture.mask.expand_as(alpha)
            return Frequencies(inside, 1.0 - inside, torch.full_like(alpha[:1], 0.5))
        radius = POSE.window_radius * picture.extent
        labels, colors = picture.labels, picture.palette.colors
        return Frequencies(
            *ColorFrequencies.from_labels(labels, colors, alpha, picture.weight, radius, POSE.prior_pixels)
        )


def region_term(
    picture: PictureLevel, seen: RenderedPoses, colors: Frequencies, visible: Tensor, mixed: Tensor | None, sigma: float
) -> Term:  # fmt: skip
    """Return the term of N silhouettes, with alpha blurred by `sigma` pixels; `visible` (N, h, w) weights the pixels of the
    renders' box. Another term says what share `mixed` ones show of each side."""
    away = (colors.outside / colors.every).log() * picture.weight
    far = away.sum((1, 2)) - seen.box.cut(away).sum((1, 2))
    inside, outside, every = (seen.box.cut(one) for one in colors)
    weight = seen.box.cut(picture.weight) * visible
    if mixed is not None:
        weight = (weight - mixed).clamp(min=0.0)
    soft = smoothed(seen.alpha, sigma)
    likelihood = soft * inside + (1.0 - soft) * outside + POSE.region_outliers * (inside + outside)
    gains = weight * (likelihood / every).log()
    if mixed is not None:  # It shows either side.
        gains = gains + mixed * (0.5 * (inside + outside) / every).log()
    slope = ((outside - inside) / likelihood * weight).flatten(1)
    blurred = smoothed(seen.tangents.flatten(0, 1), sigma).reshape(seen.tangents.shape).flatten(2).movedim(0, 1)
    rows = (blurred * slope[:, None]).double()  # Sums of many large numbers of both signs need more digits.
    cost, size = -(far + gains.sum((1, 2))).double(), blurred.shape[:2] + soft.shape[1:]
    return Term(cost, rows.sum(-1), rows @ rows.mT, lambda: rows.float().reshape(size), gains)
