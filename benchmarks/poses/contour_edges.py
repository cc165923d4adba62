"""How far a render's contour is from the edges of a photograph, by nothing that a fit compares.

Along normals to the contour the photograph is read where its colours change most: a maximum of the Gaussian derivative (Canny
1986), refined by a parabola.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage import measure
from torch import Tensor

from edgegrad.files.image import linear_to_srgb

SIGMA = 1.0  # pixels, of the derivative
STEP = 0.1  # pixels along a normal
STRONG = 0.03  # sRGB values a pixel: weaker edges are not counted


@dataclass(frozen=True)
class Profile:
    """The photograph across a contour."""

    points: np.ndarray  # (n, 2), x and y in pixels, on the contour
    normals: np.ndarray  # (n, 2), outwards
    along: np.ndarray  # (m,) pixels
    change: np.ndarray  # (n, m), sRGB values a pixel, of all channels together

    def maxima(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Strong edges: rows of points, pixels along their normals, and strengths."""
        left, middle, right = self.change[:, :-2], self.change[:, 1:-1], self.change[:, 2:]
        rows, columns = np.nonzero((middle > STRONG) & (middle >= left) & (middle > right))
        a, b, c = (part[rows, columns] for part in (left, middle, right))
        return rows, self.along[columns + 1] + STEP * 0.5 * (a - c) / (a - 2.0 * b + c), b

    def quantiles(self) -> list[float]:
        """Return median and 90 % quantile of the distances, in pixels."""
        return np.quantile(self.distances(), [0.5, 0.9]).tolist()

    def distances(self) -> np.ndarray:
        """Return distances (k,) in pixels from points to the strongest edges near them, of points that have one."""
        rows, offsets, strengths = self.maxima()
        best: dict[int, tuple[float, float]] = {}
        for row, offset, strength in zip(rows.tolist(), offsets.tolist(), strengths.tolist(), strict=True):
            best[row] = max(best.get(row, (0.0, 0.0)), (strength, abs(offset)))
        return np.array([offset for _, offset in best.values()])


def across(picture: Tensor, alpha: Tensor, reach: float) -> Profile:
    """Read a linear photograph (H, W, 3) across the contour of alpha (H, W), up to `reach` pixels to both sides."""
    points, normals = _outline(alpha.double().numpy())
    along = np.arange(-reach, reach + 0.5 * STEP, STEP)
    y, x = (points[:, None, k] + along * normals[:, None, k] - 0.5 for k in (1, 0))
    image = linear_to_srgb(picture.clamp(0.0, 1.0)).double().numpy()
    squares = np.zeros_like(x)
    for channel in np.moveaxis(image, -1, 0):
        slopes = [ndimage.gaussian_filter(channel, SIGMA, order=order) for order in ((0, 1), (1, 0))]  # type: ignore[arg-type]
        read = [ndimage.map_coordinates(slope, [y, x], order=1, mode="nearest") for slope in slopes]
        squares += (read[0] * normals[:, None, 0] + read[1] * normals[:, None, 1]) ** 2
    return Profile(points, normals, along, np.sqrt(squares))


def _outline(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2), x and y, of the longest contour of alpha (H, W), a pixel apart, and normals."""
    ring = max(measure.find_contours(np.pad(alpha, 1), 0.5), key=len)[:, ::-1] - 0.5  # of the first pixel's centre: 0.5
    lengths = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))]
    places = np.arange(0.0, lengths[-1], 1.0)
    points = np.stack([np.interp(places, lengths, ring[:, k]) for k in (0, 1)], -1)
    smooth = ndimage.gaussian_filter1d(points, 1.5, axis=0, mode="wrap")
    tangents = np.roll(smooth, -1, 0) - np.roll(smooth, 1, 0)
    normals = np.stack([tangents[:, 1], -tangents[:, 0]], -1) / np.linalg.norm(tangents, axis=1, keepdims=True)
    # find_contours() keeps what is higher on one side, which side that is the sign of the area tells.
    x, y = points.T
    area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    return points, normals if area > 0.0 else -normals
