"""Whether a picture shows what a fit claims.

A loss that no longer falls may have stopped at a wrong place. What tells is whether the edges of the render r are in the picture
p, and as strong: s = ⟨∇p·∇r⟩ / ⟨|∇r|²⟩, with means over a few pixels, is 1 where both are alike, 0 where an edge is missing or
two pixels off, and 2 where the picture's is twice as strong. The share that is explained is what the picture has of the render's
edge, s, or, where the picture's edge is stronger by more than its noise, what the render has of the picture's, 1/s. Its mean is
weighted by |∇r|, and noise has no part in it on average; flat regions, which match wherever the object is, do not count.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from .region import smoothed

ENOUGH = 0.6  # a smaller share is a wrong place, or a picture of something else
DEVIATIONS = 3.0  # of the noise
WINDOW = 1.0  # pixels: standard deviation of the windows in which strengths are compared
AROUND = 3.0  # the same, in which noise is counted
WILDEST = -1.0, 2.0  # strengths of one edge
BLOCK = 16  # pixels: those of JPEG with colours at half the resolution
DISPLAY = 0.01  # of the picture's range: what eight bits and a display's curve leave


def picture_noise(picture: Tensor) -> Tensor:
    """(C,) standard deviation of the noise of a picture (H, W, C), from a difference that planes and most edges leave out
    (Immerkær, Fast Noise Variance Estimation, 1996), and a median, which leaves out the other edges."""
    if min(picture.shape[:2]) < 3:
        return picture.new_zeros(picture.shape[-1])
    kernel = picture.new_tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
    second = F.conv2d(picture.movedim(-1, 0)[:, None], kernel[None, None])
    return 1.4826 * second.abs().flatten(1).median(dim=1).values


def edge_strength(image: Tensor) -> Tensor:
    """(H, W, C): the largest difference of a pixel to its neighbours."""
    padded = F.pad(image.movedim(-1, 0)[None], (1, 1, 1, 1), mode="replicate")
    high, low = F.max_pool2d(padded, 3, stride=1), -F.max_pool2d(-padded, 3, stride=1)
    return (high - low)[0].movedim(0, -1)


def explained(pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]], softer: bool = False) -> float:
    """The share, 0 … 1, over all views: of each two renders (H, W, C) of different seeds, the picture, and weights (H, W, 1).

    softer  whether the renders are blurred, and the pictures' edges are as strong before the blur: they may then be stronger by a
            factor up to 2

    Of renders without an edge, the share of the pixels that differ by no more than the noise.
    """
    edges = alike = pixels = same = 0.0
    for render, again, picture, weight in pairs:
        picture = picture.to(render)
        mean = 0.5 * (render + again)
        samples = 0.5 * (render - again).square().mean((0, 1))
        both = torch.stack([picture, mean])  # what is covered may be all that a channel shows
        extent = (both.amax((0, 1, 2)) - both.amin((0, 1, 2))).clamp(min=1e-30)
        least = DEVIATIONS * samples.sqrt() + DISPLAY * extent
        gradient = _gradient(mean)
        size = torch.hypot(*gradient)
        w = torch.ones_like(mean[..., :1]) if weight is None else weight
        count = w * size * (size > least) / extent
        found = _gradient(picture)
        own = _windowed(w * size.square(), WINDOW).clamp(min=1e-30)
        strength = _windowed(w * (gradient * found).sum(0), WINDOW) / own
        # What the picture's edges have along those of the render is noise, which blur, compression and clutter make, too.
        along = (gradient[0] * found[1] - gradient[1] * found[0]).square() / size.square().clamp(min=1e-30)
        noise = (_windowed(w * along, AROUND) / _windowed(w, AROUND).clamp(min=1e-30) + 0.5 * samples).sqrt()
        # The squares of a Gaussian window's weights are the weights of a window narrower by √2.
        spread = (_windowed(w * size.square(), WINDOW / math.sqrt(2.0)) / (4.0 * math.pi)).sqrt() / (WINDOW * own)
        stronger = strength > (WILDEST[1] if softer else 1.0) + DEVIATIONS * noise * spread
        share = torch.where(stronger, strength.clamp(min=1.0).reciprocal(), strength.clamp(*WILDEST))
        edges += float(count.sum())
        alike += float((count * share).sum())
        pixels += float(w.sum()) * mean.shape[-1]
        same += float((w * ((mean - picture).abs() <= least + DEVIATIONS * picture_noise(picture))).sum())
    return max(0.0, min(1.0, alike / edges)) if edges > 1e-4 * pixels else same / max(pixels, 1e-30)


def edges_of(pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]]) -> float:
    """How much of edges there is in renders that explained() takes: pixels long, times their contrast by the pictures' range."""
    total = 0.0
    for render, again, picture, weight in pairs:
        extent = (picture.amax((0, 1)) - picture.amin((0, 1))).clamp(min=1e-30)
        edges = _gradient(0.5 * (render + again)).norm(dim=0) / extent
        total += float((edges if weight is None else weight * edges).sum())
    return total


def coherent(pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]]) -> float:
    """How far renders are from pictures, as explained() takes them, where blocks are compared by their means: the root of the
    mean square, as a part of the pictures' range, over the blocks that the render's edges are in, by their strength.

    A mean leaves out what blur, compression and noise do to a picture, all of which keep it, and what a pose that is a part of a
    pixel off does; not what covers the object, or is of another colour.
    """
    total = count = 0.0
    for render, again, picture, weight in pairs:
        picture = picture.to(render)
        w = torch.ones_like(render[..., :1]) if weight is None else weight
        mean = 0.5 * (render + again)
        extent = (picture.amax((0, 1)) - picture.amin((0, 1))).clamp(min=1e-30)
        r = _blocks(w * (mean - picture) / extent) / _blocks(w).clamp(min=1e-6)
        edges = _blocks(w * _gradient(mean).norm(dim=0) / extent)
        total += float((edges * r.square()).sum())
        count += float(edges.sum())
    return (total / max(count, 1e-30)) ** 0.5


def _blocks(image: Tensor) -> Tensor:
    """(h, w, C), means over BLOCK × BLOCK pixels."""
    H, W = (max(1, round(n / BLOCK)) for n in image.shape[:2])
    return F.adaptive_avg_pool2d(image.movedim(-1, 0)[None], (H, W))[0].movedim(0, -1)


def _windowed(image: Tensor, sigma: float) -> Tensor:
    """(H, W, C), means over Gaussian windows of a standard deviation in pixels."""
    return smoothed(image.movedim(-1, 0), sigma).movedim(0, -1)


def _gradient(image: Tensor) -> Tensor:
    """(2, H, W, C), central differences."""
    padded = F.pad(image.movedim(-1, 0)[None], (1, 1, 1, 1), mode="replicate")[0].movedim(0, -1)
    return 0.5 * torch.stack([padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]])
