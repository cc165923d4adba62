"""Whether a picture shows what a fit claims.

A loss that no longer falls may have stopped at a wrong place. What tells is whether the edges of the render r are in the picture
p: the mean of ∇p·∇r / |∇r|² over the pixels, weighted by |∇r|. It is 1 where both are alike, whatever the noise of p, which
has no part in ∇r on average, and 0 where an edge is missing or two pixels off; flat regions, which match wherever the object is,
do not count.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

ENOUGH = 0.6  # a smaller share is a wrong place, or a picture of something else
DEVIATIONS = 3.0  # of the noise
WILDEST = -1.0, 2.0  # of one pixel
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


def explained(pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]]) -> float:
    """The share, 0 … 1, over all views: of each two renders (H, W, C) of different seeds, the picture, and weights (H, W, 1).

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
        share = (gradient * _gradient(picture)).sum(0) / size.square().clamp(min=1e-30)
        edges += float(count.sum())
        alike += float((count * share.clamp(*WILDEST)).sum())
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


def _gradient(image: Tensor) -> Tensor:
    """(2, H, W, C), central differences."""
    padded = F.pad(image.movedim(-1, 0)[None], (1, 1, 1, 1), mode="replicate")[0].movedim(0, -1)
    return 0.5 * torch.stack([padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]])
