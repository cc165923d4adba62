"""The contour term: across the silhouette a pixel mixes the colours of both sides by the share that the object covers.

Lenses and sensors mix radiance, and the display's curve comes after, see contour_colors.py. The region term decides on which
side of the contour a pixel lies; this one measures its share of each side. Both sides are means of the picture a little inside
and a little outside, or the background where that is known; their variances weight the difference. The cost is half the robust
squares, in variances, less their expectation from noise, so that longer contours are no less likely.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ....files.image import linear_to_srgb, srgb_slope, srgb_to_linear
from ...contour_colors import PURE, SUPPORT
from ...region import smoothed
from ..settings import POSE
from .picture import PictureLevel, RenderedPoses
from .term import Term

MIN_VISIBLE = 0.3  # A pixel that something else probably covers shows no contour.


class Sides(NamedTuple):
    """The colours on both sides of N contours, the 0.5 level of a blurred alpha, and their mixture across it."""

    alpha: Tensor  # (N, h, w)
    contrast: Tensor  # (N, h, w), difference of both sides in standard deviations
    band: Tensor  # (N, h, w), weights of the mixed pixels whose sides are both known
    mixed: Tensor  # (N, C, h, w), what the picture shows if the contour is right
    step: Tensor  # (N, C, h, w), its derivative by alpha
    variance: Tensor  # (N, C, h, w)

    @staticmethod
    def from_picture(
        picture: PictureLevel, seen: RenderedPoses, visible: Tensor, blur: float, window: float = POSE.contour_window
    ) -> Sides:  # fmt: skip
        """Measure the colours in the picture of a box, in windows of so many pixels; `visible` (N, h, w) weights the pixels."""
        alpha = smoothed(seen.alpha, blur)
        image, curved = picture.outlined, picture.mask is None  # A mask's values mix as they are.
        near = picture.weight * visible
        behind = torch.zeros_like(image) if picture.background is None else picture.background
        front, front_variance, front_count = _local(
            image.expand(len(alpha), -1, -1, -1), (alpha > 1.0 - PURE) * near, window
        )
        back, back_variance, back_count = _local((image - behind).expand_as(front), (alpha < PURE) * near, window)
        known = (front_count > SUPPORT) & (back_count > SUPPORT) & (near > MIN_VISIBLE)
        a = alpha[:, None]
        variance = picture.noise**2 + a.square() * front_variance + (1.0 - a).square() * back_variance
        back = back + behind
        contrast = ((front - back).square() / variance).sum(1).sqrt()
        if curved:
            front, back = (srgb_to_linear(side.clamp(0.0, 1.0)) for side in (front, back))
        mixed, step = back + a * (front - back), front - back
        if curved:
            mixed = linear_to_srgb(mixed.clamp(0.0, 1.0))
            step = srgb_slope(mixed) * step
        band = ((alpha > PURE) & (alpha < 1.0 - PURE) & known) * near
        return Sides(alpha, contrast, band, mixed, step, variance)


def contour_term(picture: PictureLevel, seen: RenderedPoses, visible: Tensor, blur: float) -> Term:
    """Return the term of N silhouettes for the picture of their box, with alpha blurred by so many pixels. `visible` (N, h, w)
    weights the pixels."""
    sides = Sides.from_picture(picture, seen, visible, blur)
    deviation, band = sides.variance.sqrt(), sides.band
    residual, step = (sides.mixed - picture.outlined) / deviation, sides.step / deviation
    squares, channels = residual.square().sum(1), len(picture.outlined)
    tolerance = POSE.contour_tolerance
    excess = squares / (1.0 + squares / tolerance) - channels / (1.0 + channels / tolerance)
    enough = ((band > 0.0).sum((1, 2)) >= POSE.min_contour_pixels).float()
    rows = smoothed(seen.tangents.flatten(0, 1), blur).reshape(seen.tangents.shape).flatten(2).movedim(0, 1)
    robust = ((1.0 + squares / tolerance).pow(-2) * band) * enough[:, None, None]
    # One row of J serves all channels, whose slopes by alpha are `step`.
    strength = step.square().sum(1)
    along = (residual * step).sum(1) / strength.clamp(min=1e-12)
    cost = 0.5 * (band * excess).sum((1, 2))
    return Term.from_rows(cost, rows, (robust * strength).flatten(1), along.flatten(1))


def _local(image: Tensor, share: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean and variance (N, C, h, w) of pixels in each pixel's window, weighted by `share` (N, h, w), and its weight."""
    count = smoothed(share, sigma)
    enough = count.clamp(min=1e-4)[:, None]

    def mean(values: Tensor) -> Tensor:
        blurred = smoothed((values * share[:, None]).flatten(0, 1), sigma)
        return blurred.reshape(values.shape) / enough

    first = mean(image)
    return first, (mean(image.square()) - first.square()).clamp(min=0.0), count
