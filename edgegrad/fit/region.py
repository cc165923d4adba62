"""The region term: the object is where the colours are that it has, beside those that lie around it.

Of a pixel x whose colour is p_f as frequent inside the silhouette, near x, and p_b outside of it, the posterior that it shows the
object is P = p_f / (p_f + p_b). A render covers the share α of it, so the likelihood is f = α P + (1 − α)(1 − P), and the loss
−Σ log f (Prisacariu and Reid, PWP3D, 2012). Colours are counted near each pixel, for those of the whole picture seldom tell an
object from what surrounds it (Tjaden et al., A Region-Based Gauss-Newton Approach, 2017).

The gradient is Σ s ∇α with s = −(2P − 1)/f, with P held fixed, and the curvature is Σ of the squares of the same, Fisher's
information.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

COLOURS = 96  # of a palette
SAMPLED, ROUNDS = 8000, 12  # pixels that a palette is made from, and rounds
CELLS = 3.0  # across the radius of the windows in which colours are counted
AROUND = 0.25  # of the object's extent in the image, where colours count as those that surround it
RADIUS = 0.15  # of windows in which colours are counted, in the object's extent in the image
VISIBLE = 10  # pixels that a render must cover
LEAST = 1e-4  # frequency of any colour
OUTLIERS = 1e-3  # likelihood of pixels that tell nothing


def posterior(windows: Windows, alpha: Tensor, near: Tensor) -> Tensor:
    """(h, w), of the colours as the silhouette alpha (h, w) divides them; `near` (h, w) counts what surrounds the object."""
    inside, outside = windows.frequencies(alpha * near), windows.frequencies((1.0 - alpha) * near)
    return (inside + LEAST) / (inside + outside + 2.0 * LEAST)


def likelihood(posterior: Tensor, alpha: Tensor) -> Tensor:
    """f (h, w) of the shares alpha."""
    return alpha * posterior + (1.0 - alpha) * (1.0 - posterior) + OUTLIERS


def slope(posterior: Tensor, alpha: Tensor) -> Tensor:
    """s (h, w), the derivative of −log f by alpha."""
    return (1.0 - 2.0 * posterior) / likelihood(posterior, alpha)


def told(posterior: Tensor, alpha: Tensor) -> Tensor:
    """(h, w): how many bits more likely a pixel is than if its colour told nothing, P = ½: 1 where it is sure and right."""
    return 1.0 + likelihood(posterior, alpha).log2()


def around(alpha: Tensor) -> tuple[Tensor, float]:
    """What surrounds the object (h, w), and its extent, pixels; 0 where it is not seen."""
    rows, columns = torch.nonzero(alpha > 0.5, as_tuple=True)
    near = torch.zeros_like(alpha)
    if len(rows) < VISIBLE:
        return near, 0.0
    low, high = (int(rows.min()), int(columns.min())), (int(rows.max()), int(columns.max()))
    extent = math.hypot(high[0] - low[0], high[1] - low[1])
    margin = int(AROUND * extent) + 2
    near[max(0, low[0] - margin) : high[0] + margin, max(0, low[1] - margin) : high[1] + margin] = 1.0
    return near, extent


class Palette:
    """A few colours (n, C), and for every colour which of them is nearest."""

    CELLS = 32  # of three channels each, in which all colours have the same one of the palette

    def __init__(self, colours: Tensor) -> None:
        self.colours = colours
        self._table: Tensor | None = None
        if colours.shape[1] == 3:
            middle = (torch.arange(self.CELLS) + 0.5) / self.CELLS
            self._table = self._nearest(torch.cartesian_prod(middle, middle, middle))

    def labels(self, display: Tensor) -> Tensor:
        """(h · w,), of a picture (h, w, C)."""
        pixels = display.flatten(0, 1)
        if self._table is None:
            return self._nearest(pixels)
        r, g, b = (pixels * self.CELLS).long().clamp(0, self.CELLS - 1).unbind(-1)
        return self._table[(r * self.CELLS + g) * self.CELLS + b]

    def _nearest(self, pixels: Tensor) -> Tensor:
        return torch.cdist(pixels, self.colours).argmin(1)


def palette(display: Tensor, seed: int) -> Palette:
    """Of colours that stand for those of (h, w, C): Lloyd's algorithm (k-means), from pixels drawn at random."""
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
    return Palette(colours)


class Windows:
    """Windows all over a picture, in which its colours are counted; a colour also counts as those that look like it."""

    ALIKE = 0.06  # standard deviation of colours that look alike, in sRGB values
    WIDTH = 1.5  # standard deviation of a window, in cells
    LEAST = 1e-3  # pixels of all colours that every window has
    PRESENT = 0.1  # pixels in a window's cell: with fewer, nothing is known of their colours

    def __init__(self, size: tuple[int, int], label: Tensor, colours: Tensor, radius: float) -> None:
        """`label` (h · w,): what Palette.labels() gives for the colours (n, C)."""
        h, w = size
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
