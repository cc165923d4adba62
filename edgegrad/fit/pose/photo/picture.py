"""A photograph at one resolution: its colours, and which of a few each pixel has."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ....camera.camera import Camera
from ....files.image import linear_to_srgb
from ...views import area_mean
from ..task import Shot

COLOURS = 96  # of a palette
SAMPLED, ROUNDS = 8000, 12  # pixels that a palette is made from, and rounds
CELLS = 3.0  # across the radius of the windows in which colours are counted


@dataclass(frozen=True)
class Picture:
    """What the terms compare renders with. `display` is in sRGB values, in which noise, blur and compression of photographs are
    nearly even."""

    camera: Camera
    radiance: Tensor  # (h, w, C), linear
    display: Tensor  # (h, w, C)
    mask: Tensor | None  # (h, w), 1 on the object
    weight: Tensor  # (h, w), how much a pixel counts
    depth: Tensor | None  # (h, w), NaN where it was not measured

    @staticmethod
    def of(shot: Shot, masked: bool, depth: Tensor | None, size: tuple[int, int]) -> Picture:
        """`masked`: the last channel of what the shot has is a mask."""
        radiance, mask = area_mean(shot.target, size), None
        if masked:
            radiance, mask = radiance[..., :-1], radiance[..., -1].clamp(0.0, 1.0)
        weight = torch.ones(size) if shot.weight is None else area_mean(shot.weight, size)[..., 0]
        nearest = None if depth is None else F.interpolate(depth[None, None], size, mode="nearest-exact")[0, 0]
        return Picture(
            shot.camera.resized(size), radiance, linear_to_srgb(radiance.clamp(0.0, 1.0)), mask, weight, nearest
        )

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.camera.size

    def labels(self, colours: Tensor) -> Tensor:
        """(h · w,): which of the colours (n, C) is nearest to that of each pixel."""
        return torch.cdist(self.display.flatten(0, 1), colours).argmin(1)

    @property
    def outlined(self) -> Tensor:
        """(h, w, c), what shows the outline of the object: the mask, or else the colours."""
        return self.display if self.mask is None else self.mask[..., None]


def palette(display: Tensor, seed: int) -> Tensor:
    """(n, C) colours that stand for those of (h, w, C): Lloyd's algorithm (k-means), from pixels drawn at random."""
    generator = torch.Generator().manual_seed(seed)
    pixels = display.flatten(0, 1)
    pixels = pixels[torch.randperm(len(pixels), generator=generator)[:SAMPLED]]
    colours = pixels[:COLOURS].clone()
    for _ in range(ROUNDS):
        distance = torch.cdist(pixels, colours)
        nearest = distance.argmin(1)
        count = torch.bincount(nearest, minlength=len(colours))[:, None]
        mean = torch.zeros_like(colours).index_add_(0, nearest, pixels) / count.clamp(min=1)
        lonely = pixels[distance.amin(1).topk(len(colours)).indices]  # colours that nothing is near to start anew
        colours = torch.where(count > 0, mean, lonely)
    return colours


class Windows:
    """Windows all over a picture, in which its colours are counted; a colour also counts as those that look like it."""

    ALIKE = 0.06  # standard deviation of colours that look alike, in sRGB values
    WIDTH = 1.5  # standard deviation of a window, in cells
    LEAST = 1e-3  # pixels of all colours that every window has
    PRESENT = 0.1  # pixels in a window's cell: with fewer, nothing is known of their colours

    def __init__(self, picture: Picture, label: Tensor, colours: Tensor, radius: float) -> None:
        """`label` (h · w,): what Picture.labels() gives for the colours (n, C)."""
        h, w = picture.size
        cell = max(1.0, radius / CELLS)
        self.shape = math.ceil(h / cell), math.ceil(w / cell)
        rows, columns = (torch.arange(h) / cell).long(), (torch.arange(w) / cell).long()
        self.size = h, w
        self.count = len(colours)
        self._index = label * (self.shape[0] * self.shape[1]) + (rows[:, None] * self.shape[1] + columns).flatten()
        alike = torch.exp(-0.5 * (torch.cdist(colours, colours) / self.ALIKE).square())
        self._alike = alike / alike.sum(1, keepdim=True)

    def frequencies(self, share: Tensor) -> Tensor:
        """(h, w): how frequent the colour of each pixel is in the window around it, of all that `share` (h, w) counts there."""
        counted = torch.zeros(self.count * self.shape[0] * self.shape[1])
        counted.index_add_(0, self._index, share.flatten())
        rows = self._alike.T @ counted.reshape(self.count, -1)
        windows = smoothed(rows.reshape(self.count, *self.shape), self.WIDTH)
        windows = (windows + self.LEAST / self.count) / (windows.sum(0) + self.LEAST)
        return windows.flatten()[self._index].reshape(self.size)

    def present(self, share: Tensor) -> Tensor:
        """(h, w): 1 where the window around a pixel has any of what `share` (h, w) counts, 0 where it has hardly a pixel."""
        cells = torch.zeros(self.shape[0] * self.shape[1])
        cell = self._index % (self.shape[0] * self.shape[1])
        cells.index_add_(0, cell, share.flatten())
        windows = smoothed(cells.reshape(1, *self.shape), self.WIDTH).flatten()
        return (windows / (windows + self.PRESENT))[cell].reshape(self.size)


def smoothed(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of (n, h, w) by `sigma` pixels; what lies outside counts as zero."""
    if sigma == 0.0:
        return images
    radius = math.ceil(3.0 * sigma)
    kernel = [math.exp(-0.5 * (k / sigma) ** 2) for k in range(radius + 1)]
    total = kernel[0] + 2.0 * sum(kernel[1:])
    # Sums of shifted images, which take a third of the time of torch's convolution.
    for axis in (2, 1):
        found, size = images * (kernel[0] / total), images.shape[axis]
        for k in range(1, min(radius + 1, size)):
            for to, of in ((k, 0), (0, k)):
                found.narrow(axis, to, size - k).add_(images.narrow(axis, of, size - k), alpha=kernel[k] / total)
        images = found
    return images
