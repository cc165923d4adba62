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
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

VISIBLE = 10  # pixels that a render must cover


@dataclass(frozen=True)
class RegionColors:
    """How colours are counted. Pictures have sRGB values.

    Of four brackets before clutter at 96 pixels (tests/fit/photographs.py) three are found, 2.1°, 3.6° and 2.5° off, and the
    fourth is lost. Half or twice a number changes the three by less than 0.7°, where it does not say otherwise.
    """

    palette: int = 96  # colours; the third bracket is 4.0° off with half
    sampled: int = 8000  # pixels from which a palette is chosen
    lloyd_rounds: int = 12
    similar: float = 0.06  # standard deviation of similar colours; the third is 5.6° off with half, 3.6° with twice
    # Of the windows in which colours are counted, in extents of the object: half finds the fourth, with the third 3.5° off.
    radius: float = 0.15
    cells: float = 3.0  # across this radius; twice is as half the radius
    window_width: float = 1.5  # standard deviation of a window, in cells
    prior_pixels: float = 1e-3  # of the whole picture's colours, which each window has besides its own
    margin: float = 0.25  # width of the surroundings whose colours are counted, in extents of the object
    min_frequency: float = 1e-4  # of any colour
    outliers: float = 1e-3  # likelihood of pixels whose colour says nothing


COLORS = RegionColors()


def likelihood(posterior: Tensor, alpha: Tensor) -> Tensor:
    """Return f (h, w) of the shares alpha (h, w)."""
    return alpha * posterior + (1.0 - alpha) * (1.0 - posterior) + COLORS.outliers


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
    margin = int(COLORS.margin * extent) + 2
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
    pixels = pixels[torch.randperm(len(pixels), generator=generator)[: COLORS.sampled]]
    colors = pixels[: COLORS.palette].clone()
    for _ in range(COLORS.lloyd_rounds):
        distance = torch.cdist(pixels, colors)
        nearest = distance.argmin(1)
        count = torch.bincount(nearest, minlength=len(colors))[:, None]
        mean = torch.zeros_like(colors).index_add_(0, nearest, pixels) / count.clamp(min=1)
        lonely = pixels[distance.amin(1).topk(len(colors)).indices]  # where colours without pixels start anew
        colors = torch.where(count > 0, mean, lonely)
    return Palette(colors)


class ColorFrequencies(NamedTuple):
    """How frequent pixels' colours are nearby, (N, h, w), as N silhouettes divide a picture. A colour also counts as similar
    colours."""

    inside: Tensor
    outside: Tensor
    every: Tensor  # (1, h, w), the same for any silhouette

    @staticmethod
    def from_labels(
        labels: Tensor, colors: Tensor, alpha: Tensor, weight: Tensor, radius: float, prior_pixels: float
    ) -> ColorFrequencies:
        """Count the colours in windows all over a picture.

        labels, colors  Palette.labels() of the picture, and the palette's colours (n, C)
        alpha, weight   silhouettes (N, h, w), and how much each pixel (h, w) counts
        radius          of a window, in pixels
        prior_pixels    The colours of the whole picture count as so many pixels in each window.
        """
        (N, h, w), count = alpha.shape, len(colors)
        cell = max(1.0, radius / COLORS.cells)
        rows, columns = ((torch.arange(n, dtype=torch.float32) / cell).long() for n in (h, w))
        shape = math.ceil(h / cell), math.ceil(w / cell)
        cells = shape[0] * shape[1]
        index = labels * cells + (rows[:, None] * shape[1] + columns).flatten()
        similar = torch.exp(-0.5 * (torch.cdist(colors, colors) / COLORS.similar).square())
        similar = (similar / similar.sum(1, keepdim=True)).T
        whole = torch.zeros(count, dtype=torch.float32).index_add_(0, labels, weight.flatten())
        prior = prior_pixels * (similar @ whole)[:, None] / whole.sum().clamp(min=1e-30)
        shares = torch.cat([alpha * weight, weight[None]]).flatten(1)
        counted = torch.zeros(N + 1, count * cells, dtype=torch.float32).index_add_(1, index, shares)
        windows = smoothed((similar @ counted.reshape(N + 1, count, cells)).reshape(-1, *shape), COLORS.window_width)
        inside, every = windows.reshape(N + 1, count, cells).split([N, 1])

        def frequency(window: Tensor) -> Tensor:
            found = (window + prior) / (window.sum(1, keepdim=True) + prior_pixels)
            return found.flatten(1)[:, index].reshape(-1, h, w) + COLORS.min_frequency

        return ColorFrequencies(frequency(inside), frequency((every - inside).clamp(min=0.0)), frequency(every))

    @property
    def posterior(self) -> Tensor:
        """P (N, h, w) of the pixels' colours."""
        return self.inside / (self.inside + self.outside)


SMALL = 48  # pixels: products with matrices blur smaller images in a third of the time


def smoothed(images: Tensor, sigma: float) -> Tensor:
    """Blur (n, h, w) by a Gaussian of `sigma` pixels, with zeros beyond the border."""
    if sigma == 0.0:
        return images
    if max(images.shape[1:]) <= SMALL:
        rows, columns = (blurring(size, sigma).to(images) for size in images.shape[1:])
        return rows @ (images @ columns)
    kernel = gaussian(sigma)
    # Sums of shifted images take a third of the time of torch's convolution.
    for axis in (2, 1):
        found, size = images * kernel[0], images.shape[axis]
        for k in range(1, min(len(kernel), size)):
            for to, of in ((k, 0), (0, k)):
                found.narrow(axis, to, size - k).add_(images.narrow(axis, of, size - k), alpha=kernel[k])
        images = found
    return images


def gaussian(sigma: float) -> list[float]:
    """Return the weights of a pixel, of the next one, and so on up to three standard deviations."""
    kernel = [math.exp(-0.5 * (k / sigma) ** 2) for k in range(math.ceil(3.0 * sigma) + 1)]
    return [weight / (2.0 * sum(kernel) - kernel[0]) for weight in kernel]


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def blurring(size: int, sigma: float) -> Tensor:
    """Return the symmetric matrix (size, size) that blurs rows of so many pixels."""
    matrix = torch.zeros(size, size, dtype=torch.float32)
    for k, weight in enumerate(gaussian(sigma)[:size]):
        matrix.diagonal(k).fill_(weight)
        matrix.diagonal(-k).fill_(weight)
    return matrix


def smoothed_within(images: Tensor, sigma: float) -> Tensor:
    """Blur whole pictures (n, h, w) as if they went on beyond the border as they are there: what a border cuts has no edge."""
    return smoothed(images, sigma) / smoothed(torch.ones_like(images[:1]), sigma)
