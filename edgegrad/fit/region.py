"""The region term: the object is where the colours are that are frequent inside its silhouette and rare around it.

A pixel's colour has frequency p_f near the pixel inside the silhouette, and p_b outside of it. The posterior that the pixel
shows the object is P = p_f / (p_f + p_b). A render covers the share α of the pixel, so the likelihood is f = α P + (1 − α)(1 −
P), and the loss is −Σ log f (Prisacariu and Reid, PWP3D, 2012). Colours are counted near each pixel, for colours of the whole
picture seldom separate an object from its surroundings (Tjaden et al., A Region-Based Gauss-Newton Approach, 2017).

With P held fixed, the gradient is Σ s ∇α with s = −(2P − 1)/f. The curvature is the sum of the squares of its terms, Fisher's
information.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

COLOURS = 96  # of a palette
SAMPLED, LLOYD_ROUNDS = 8000, 12  # pixels from which a palette is chosen, and iterations
CELLS = 3.0  # across the radius of the windows in which colours are counted
MARGIN = 0.25  # width of the surroundings whose colours are counted, in extents of the object in the image
RADIUS = 0.15  # of the windows in which colours are counted, in extents of the object in the image
VISIBLE = 10  # pixels that a render must cover
MIN_FREQUENCY = 1e-4  # of any colour
OUTLIERS = 1e-3  # likelihood of pixels whose colour says nothing


def posterior(windows: Windows, alpha: Tensor, near: Tensor) -> Tensor:
    """Return P (h, w) of the colours as the silhouette alpha (h, w) divides them. `near` (h, w) weights the pixels."""
    inside, outside = windows.frequencies(alpha * near), windows.frequencies((1.0 - alpha) * near)
    return (inside + MIN_FREQUENCY) / (inside + outside + 2.0 * MIN_FREQUENCY)


def likelihood(posterior: Tensor, alpha: Tensor) -> Tensor:
    """Return f (h, w) of the shares alpha (h, w)."""
    return alpha * posterior + (1.0 - alpha) * (1.0 - posterior) + OUTLIERS


def slope(posterior: Tensor, alpha: Tensor) -> Tensor:
    """Return s (h, w), the derivative of −log f by alpha."""
    return (1.0 - 2.0 * posterior) / likelihood(posterior, alpha)


def information(posterior: Tensor, alpha: Tensor) -> Tensor:
    """Return by how many bits (h, w) a pixel is more likely than one whose colour says nothing, P = ½; 1 where it is sure and
    right."""
    return 1.0 + likelihood(posterior, alpha).log2()


def surroundings(alpha: Tensor) -> tuple[Tensor, float]:
    """Return a mask (h, w) of the pixels near the object, and the object's extent in pixels, 0 if it is not seen."""
    rows, columns = torch.nonzero(alpha > 0.5, as_tuple=True)
    near = torch.zeros_like(alpha)
    if len(rows) < VISIBLE:
        return near, 0.0
    low, high = (int(rows.min()), int(columns.min())), (int(rows.max()), int(columns.max()))
    extent = math.hypot(high[0] - low[0], high[1] - low[1])
    margin = int(MARGIN * extent) + 2
    near[max(0, low[0] - margin) : high[0] + margin, max(0, low[1] - margin) : high[1] + margin] = 1.0
    return near, extent


class Palette:
    """A few colours (n, C), and a table of the one that is nearest to any colour."""

    CELLS = 32  # a channel; all colours in a cell have the same index

    def __init__(self, colors: Tensor) -> None:
        self.colors = colors
        self._table: Tensor | None = None
        if colors.shape[1] == 3:
            middle = (torch.arange(self.CELLS, dtype=torch.float32) + 0.5) / self.CELLS
            self._table = self._nearest(torch.cartesian_prod(middle, middle, middle))

    def labels(self, display: Tensor) -> Tensor:
        """Return the index (h · w,) of the palette's colour for each pixel of a picture (h, w, C)."""
        pixels = display.flatten(0, 1)
        if self._table is None:
            return self._nearest(pixels)
        r, g, b = (pixels * self.CELLS).long().clamp(0, self.CELLS - 1).unbind(-1)
        return self._table[(r * self.CELLS + g) * self.CELLS + b]

    def _nearest(self, pixels: Tensor) -> Tensor:
        return torch.cdist(pixels, self.colors).argmin(1)


def palette(display: Tensor, seed: int) -> Palette:
    """Choose a palette for a picture (h, w, C): Lloyd's algorithm (k-means) from pixels drawn at random."""
    generator = torch.Generator().manual_seed(seed)
    pixels = display.flatten(0, 1)
    pixels = pixels[torch.randperm(len(pixels), generator=generator)[:SAMPLED]]
    colors = pixels[:COLOURS].clone()
    for _ in range(LLOYD_ROUNDS):
        distance = torch.cdist(pixels, colors)
        nearest = distance.argmin(1)
        count = torch.bincount(nearest, minlength=len(colors))[:, None]
        mean = torch.zeros_like(colors).index_add_(0, nearest, pixels) / count.clamp(min=1)
        lonely = pixels[distance.amin(1).topk(len(colors)).indices]  # where colours without pixels start anew
        colors = torch.where(count > 0, mean, lonely)
    return Palette(colors)


class Windows:
    """Windows all over a picture in which its colours are counted. A colour also counts as similar colours."""

    COLOUR_SIGMA = 0.06  # standard deviation of similar colours, in sRGB values
    WIDTH = 1.5  # standard deviation of a window, in cells
    MIN_COUNT = 1e-3  # pixels of all colours that are added to every window

    def __init__(self, size: tuple[int, int], label: Tensor, colors: Tensor, radius: float) -> None:
        """`label` (h · w,) is Palette.labels() for the palette's colours (n, C); `radius` of a window in pixels."""
        h, w = size
        cell = max(1.0, radius / CELLS)
        self.shape = math.ceil(h / cell), math.ceil(w / cell)
        rows, columns = ((torch.arange(n, dtype=torch.float32) / cell).long() for n in size)
        self.size = h, w
        self.count = len(colors)
        self._index = label * (self.shape[0] * self.shape[1]) + (rows[:, None] * self.shape[1] + columns).flatten()
        similar = torch.exp(-0.5 * (torch.cdist(colors, colors) / self.COLOUR_SIGMA).square())
        self._kernel = similar / similar.sum(1, keepdim=True)

    def frequencies(self, share: Tensor) -> Tensor:
        """Return the frequency (h, w) of each pixel's colour in its window, among what `share` (h, w) weights."""
        counted = torch.zeros(self.count * self.shape[0] * self.shape[1], dtype=torch.float32)
        counted.index_add_(0, self._index, share.flatten())
        rows = self._kernel.T @ counted.reshape(self.count, -1)
        windows = smoothed(rows.reshape(self.count, *self.shape), self.WIDTH)
        windows = (windows + self.MIN_COUNT / self.count) / (windows.sum(0) + self.MIN_COUNT)
        return windows.flatten()[self._index].reshape(self.size)


def smoothed(images: Tensor, sigma: float) -> Tensor:
    """Blur (n, h, w) by a Gaussian of `sigma` pixels, with zeros beyond the border."""
    if sigma == 0.0:
        return images
    radius = math.ceil(3.0 * sigma)
    kernel = [math.exp(-0.5 * (k / sigma) ** 2) for k in range(radius + 1)]
    total = kernel[0] + 2.0 * sum(kernel[1:])
    # Sums of shifted images take a third of the time of torch's convolution.
    for axis in (2, 1):
        found, size = images * (kernel[0] / total), images.shape[axis]
        for k in range(1, min(radius + 1, size)):
            for to, of in ((k, 0), (0, k)):
                found.narrow(axis, to, size - k).add_(images.narrow(axis, of, size - k), alpha=kernel[k] / total)
        images = found
    return images
