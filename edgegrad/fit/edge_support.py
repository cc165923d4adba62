"""Edge support: the share of a render's edges that a picture shows too.

A loss that no longer falls may have stopped at a wrong place. So the edges of the render r are looked for in the picture p: s =
⟨∇p·∇r⟩ / ⟨|∇r|²⟩, with means over a few pixels. s is 1 for equal edges, 0 where an edge is missing or two pixels off, and 2
where the picture's edge is twice as strong. Where the picture's edge is stronger by more than its noise, the support is 1/s,
else s. The result is its mean weighted by |∇r|. Noise cancels on average, and flat regions, which match wherever the object is,
do not count.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from .region import smoothed

MIN_EDGE_SUPPORT = 0.6  # a smaller share means a wrong place, or a picture of something else
NOISE_DEVIATIONS = 3.0  # of the noise
WINDOW = 1.0  # standard deviation in pixels of the windows in which strengths are compared
NOISE_WINDOW = 3.0  # standard deviation in pixels of the windows in which noise is measured
STRENGTH_RANGE = -1.0, 2.0  # strengths of one edge
DISPLAY_NOISE = 0.01  # of the picture's range: what eight bits and the sRGB curve leave


def picture_noise(picture: Tensor) -> Tensor:
    """Return the standard deviation (C,) of the noise of a picture (H, W, C). The estimate uses a difference that leaves out
    planes and most edges (Immerkær, Fast Noise Variance Estimation, 1996), and a median that leaves out the other edges."""
    if min(picture.shape[:2]) < 3:
        return picture.new_zeros(picture.shape[-1])
    kernel = picture.new_tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
    second = F.conv2d(picture.movedim(-1, 0)[:, None], kernel[None, None])
    return 1.4826 * second.abs().flatten(1).median(dim=1).values


def edge_support(pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]], softer: bool = False) -> float:
    """Return the share, 0 … 1, of the renders' edges that the pictures show, over all views.

    pairs   two renders (H, W, C) of different seeds, the picture, and weights (H, W, 1) or None, of each view
    softer  whether renders are blurred more than the pictures: a picture's edge may then be up to twice as strong

    For renders without an edge, it is the share of the pixels that differ by no more than the noise.
    """
    edges = supported = pixels = same = 0.0
    for render, again, picture, weight in pairs:
        picture = picture.to(render)
        mean = 0.5 * (render + again)
        samples = 0.5 * (render - again).square().mean((0, 1))
        both = torch.stack([picture, mean])  # a channel may show nothing but what is covered
        extent = (both.amax((0, 1, 2)) - both.amin((0, 1, 2))).clamp(min=1e-30)
        least = NOISE_DEVIATIONS * samples.sqrt() + DISPLAY_NOISE * extent
        gradient = _gradient(mean)
        size = torch.hypot(*gradient)
        w = torch.ones_like(mean[..., :1]) if weight is None else weight
        count = w * size * (size > least) / extent
        found = _gradient(picture)
        own = _windowed(w * size.square(), WINDOW).clamp(min=1e-30)
        strength = _windowed(w * (gradient * found).sum(0), WINDOW) / own
        # The component of the picture's gradient along the render's edges is noise, or blur, compression or clutter.
        along = (gradient[0] * found[1] - gradient[1] * found[0]).square() / size.square().clamp(min=1e-30)
        noise = (
            _windowed(w * along, NOISE_WINDOW) / _windowed(w, NOISE_WINDOW).clamp(min=1e-30) + 0.5 * samples
        ).sqrt()
        # The squares of a Gaussian window's weights are the weights of a window narrower by √2.
        spread = (_windowed(w * size.square(), WINDOW / math.sqrt(2.0)) / (4.0 * math.pi)).sqrt() / (WINDOW * own)
        stronger = strength > (STRENGTH_RANGE[1] if softer else 1.0) + NOISE_DEVIATIONS * noise * spread
        share = torch.where(stronger, strength.clamp(min=1.0).reciprocal(), strength.clamp(*STRENGTH_RANGE))
        edges += float(count.sum())
        supported += float((count * share).sum())
        pixels += float(w.sum()) * mean.shape[-1]
        same += float((w * ((mean - picture).abs() <= least + NOISE_DEVIATIONS * picture_noise(picture))).sum())
    return max(0.0, min(1.0, supported / edges)) if edges > 1e-4 * pixels else same / max(pixels, 1e-30)


def edge_amount(pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]]) -> float:
    """Return the length in pixels of the renders' edges, times their contrast relative to the pictures' range."""
    total = 0.0
    for render, again, picture, weight in pairs:
        extent = (picture.amax((0, 1)) - picture.amin((0, 1))).clamp(min=1e-30)
        edges = _gradient(0.5 * (render + again)).norm(dim=0) / extent
        total += float((edges if weight is None else weight * edges).sum())
    return total


def _windowed(image: Tensor, sigma: float) -> Tensor:
    """Return means (H, W, C) over Gaussian windows of standard deviation `sigma` in pixels."""
    return smoothed(image.movedim(-1, 0), sigma).movedim(0, -1)


def _gradient(image: Tensor) -> Tensor:
    """Return central differences (2, H, W, C)."""
    padded = F.pad(image.movedim(-1, 0)[None], (1, 1, 1, 1), mode="replicate")[0].movedim(0, -1)
    return 0.5 * torch.stack([padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]])
