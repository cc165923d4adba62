"""The colours on both sides of a contour, and their mixture across it.

A pixel that is covered by the share α shows α F + (1 − α) B, with the radiances F of the object and B of what is behind it. F
and B are means of the picture a little inside and a little outside, and vary there by their textures. Lenses and sensors mix
radiance, and the display's curve comes after: half of white and half of black is 0.73 in sRGB values. Mixing sRGB values would
put contours on the dark side of edges, by 0.1 … 0.2 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..files.image import linear_to_srgb, srgb_slope, srgb_to_linear
from .edge_support import edge_support
from .region import smoothed, smoothed_within

COLOUR_WINDOW = 2.0  # standard deviation in pixels of the windows from which colours are taken
PIXEL_NOISE = 0.03  # standard deviation of a pixel, sRGB values
PURE = 0.03  # largest share of the other side in a pixel that counts as one side alone
SUPPORT = 0.03  # least weight of a window
CONTRAST = 2.0  # standard deviations between the sides of a visible contour
CONTOUR_BLUR = 0.9  # pixels, of alpha: about the blur of photographs at full size
CONTOUR_BLURS = 0.3, 0.5, 0.7, CONTOUR_BLUR  # of one picture; wider ones pass for an offset of the contour
TOLERANCE = 12.0  # squared differences in variances; far larger ones hardly count (Geman and McClure 1987)
# Share of the contour that must be visible where nothing else is compared; below it, edge support falls in proportion. Wrong
# places in clutter show 0.5 … 0.7, right ones 0.85 and more.
ALONE_SHOWN = 0.85
# Bits per pixel that colours next to such a contour must hold; below it, edge support falls in proportion. Fits find up to 0.36
# in clutter, up to 0.45 on another object's contour, and mostly 0.48 … 0.9 where the object is.
ALONE_INFORMATION = 0.48
OUTLINE = 1.0, 0.8, 0.0  # linear radiance
MIN_MIXED = 0.1  # of the pixels along a mask's border; a mask with fewer mixed ones is of zeros and ones
CONTOUR_STEP = 0.3  # of alpha between neighbours, where a contour is drawn


class ContourColors(NamedTuple):
    """The colours on both sides of N contours, the 0.5 level of a blurred alpha."""

    alpha: Tensor  # (N, h, w)
    behind: Tensor  # (N, C, h, w), linear radiance
    step: Tensor  # (N, C, h, w), from there to the object's
    variance: Tensor  # (N, C, h, w), of their mixture
    contrast: Tensor  # (N, h, w), difference of both sides in standard deviations
    band: Tensor  # (N, h, w) bool: mixed pixels whose sides are both known

    @staticmethod
    def from_image(image: Tensor, alpha: Tensor, near: Tensor) -> ContourColors:
        """Measure the colours in images (N, C, h, w) of sRGB values. `near` (N, h, w) says how much each pixel counts."""
        front, front_variance, front_count = local_colors(image, (alpha > 1.0 - PURE) * near, COLOUR_WINDOW)
        back, back_variance, back_count = local_colors(image, (alpha < PURE) * near, COLOUR_WINDOW)
        known = (front_count > SUPPORT) & (back_count > SUPPORT) & (near > 0.0)
        a = alpha[:, None]
        variance = PIXEL_NOISE**2 + a.square() * front_variance + (1.0 - a).square() * back_variance
        contrast = ((front - back).square() / variance).sum(1).sqrt()
        front, back = srgb_to_linear(front), srgb_to_linear(back)
        return ContourColors(
            alpha, back, front - back, variance, contrast, (alpha > PURE) & (alpha < 1.0 - PURE) & known
        )

    def mixed(self, alpha: Tensor) -> Tensor:
        """Return the mixture (N, C, h, w) by alpha (N, h, w), which the picture shows if the contour is right."""
        return linear_to_srgb((self.behind + alpha[:, None] * self.step).clamp(0.0, 1.0))

    def slope(self, alpha: Tensor) -> Tensor:
        """Return the derivative (N, C, h, w) of the mixture by alpha."""
        return srgb_slope(self.mixed(alpha)) * self.step

    def squares(self, alpha: Tensor, image: Tensor) -> Tensor:
        """Return squared differences (N, h, w) of images (N, C, h, w) from the mixture by alpha, over their variance."""
        return ((self.mixed(alpha) - image).square() / self.variance).sum(1)


def contour_support(parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> float:
    """Return the share, 0 … 1, of the contour that pictures show. A part is an image (1, C, h, w) in sRGB values, its alpha (1,
    h, w), and the weights (1, h, w) of the pixels near the object."""
    pairs, shown, length = [], 0.0, 0.0
    for image, alpha, near in parts:
        contour = smoothed_within(alpha, CONTOUR_BLUR)
        sides = ContourColors.from_image(image, contour, near)
        on = ((contour > PURE) & (contour < 1.0 - PURE)) * near
        length += float(on.sum())
        shown += float((on * (sides.contrast > CONTRAST) * sides.band).sum())
        mixed, picture = (one[0].movedim(0, -1) for one in (sides.mixed(contour), image))
        pairs.append((mixed, mixed, picture, (sides.band * near)[0, ..., None]))
    return edge_support(pairs, softer=True) * min(1.0, shown / length / ALONE_SHOWN) if length > 0.0 else 0.0


def blur_losses(sides: ContourColors, image: Tensor, weight: Tensor, alpha: Tensor) -> Tensor:
    """Return for each of CONTOUR_BLURS half the robust squared differences of images (N, C, h, w) from the mixture, with alpha
    (N, h, w) blurred by it, weighted (N, h, w). The tails of a blur show far in sRGB values, so one that is too wide puts
    bright contours too far out."""
    squares = torch.stack([sides.squares(smoothed(alpha, blur), image) for blur in CONTOUR_BLURS])
    return 0.5 * (sides.band * weight * squares / (1.0 + squares / TOLERANCE)).sum((1, 2, 3))


def mask_noise(mask: Tensor, factor: float) -> float:
    """Return the standard deviation, besides other noise, of the mixed pixels of a mask (H, W) whose sides were multiplied by
    `factor`. A mask of zeros and ones only says on which side of a pixel's middle the contour runs. This is off by 1/√12,
    evenly distributed, and of the 1/factor² pixels that become one, 1/factor lie on the contour."""
    between = (mask > PURE) & (mask < 1.0 - PURE)
    rows = mask[None, None]
    border = F.max_pool2d(rows, 3, 1, 1) + F.max_pool2d(-rows, 3, 1, 1) > 0.5
    if int(between.sum()) >= MIN_MIXED * int(border.sum()):
        return 0.0
    return min(1.0, factor) ** 1.5 / math.sqrt(12.0)


def draw_contour(image: Tensor, alpha: Tensor) -> Tensor:
    """Draw the contour of alpha (h, w, 1) into a linear image (h, w, C)."""
    contour = F.max_pool2d(alpha.movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1) - alpha > CONTOUR_STEP
    return torch.where(contour, image.new_tensor(OUTLINE if image.shape[-1] == 3 else [1.0] * image.shape[-1]), image)


def local_colors(image: Tensor, share: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean and variance (N, C, h, w) of pixels in each pixel's window, weighted by `share` (N, h, w), and its weight."""
    count = smoothed(share, sigma)
    enough = count.clamp(min=1e-4)[:, None]

    def mean(values: Tensor) -> Tensor:
        return smoothed((values * share[:, None]).flatten(0, 1), sigma).reshape(values.shape) / enough

    first = mean(image)
    return first, (mean(image.square()) - first.square()).clamp(min=0.0), count
