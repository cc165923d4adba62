"""Across the silhouette a picture changes from the object's colour to that of what lies behind.

A pixel that is covered by the share α shows α F + (1 − α) B, with the radiances F of the object and B of what is behind it, whose
colours are the means of the picture a little inside and a little outside. Both vary there by their textures. Lenses and sensors
mix radiance, and the display's curve comes after: half of white and half of black is 0.73 in sRGB values, so contours that were
found by mixing those would lie on the dark side of edges, by a tenth of a pixel or two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..files.image import linear_to_srgb, srgb_slope, srgb_to_linear
from .region import smoothed
from .verdict import explained

REACH = 2.0  # pixels: standard deviation of the windows that colours are taken from
NOISE = 0.03  # standard deviation of a pixel, sRGB values
PURE = 0.03  # share of the other side in a pixel of one side alone
SUPPORT = 0.03  # of a window
CONTRAST = 2.0  # of both sides of a contour that shows, in standard deviations
BLUR = 0.9  # pixels, of alpha: about that of photographs at full size
BLURS = 0.3, 0.5, 0.7, BLUR  # that of one picture; softer ones are not told from contours that are off
TOLERANCE = 12.0  # squared differences, in variances, that are far above this hardly count (Geman and McClure 1987)
# Share of the contour that has to show, where the contour is all that is compared; with less, less is explained. Wrong places
# show 0.5 … 0.7 of it in clutter, right ones 0.85 and more.
ALONE_SHOWN = 0.85
# Bits a pixel that colours must tell beside such a contour; with fewer, less is explained. Fits find up to 0.36 in clutter
# alone, on another object's contour up to 0.45, and mostly 0.48 … 0.9 where the object is.
ALONE_TOLD = 0.48
OUTLINE = 1.0, 0.8, 0.0  # linear radiance
WHOLE = 0.1  # of the pixels along a mask's border: one in which fewer are mixed is of zeros and ones
RIM = 0.3  # of alpha, between neighbours


@dataclass(frozen=True)
class Sides:
    """The colours beside a contour, of a blurred alpha (h, w)."""

    alpha: Tensor  # (h, w)
    inside: Tensor  # (h, w, C)
    outside: Tensor
    variance: Tensor  # (h, w, C) of their mixture
    band: Tensor  # (h, w) bool: where it is mixed, and both sides are known
    curved: bool = True  # colours, in sRGB values; a mask's values mix as they are

    @staticmethod
    def of(image: Tensor, alpha: Tensor, near: Tensor, curved: bool = True, noise: float = NOISE) -> Sides:
        """Of an image (h, w, C) in sRGB values, or a mask, which is not `curved`; `near` (h, w): what may be used of it. `noise`
        is the standard deviation of a pixel that is mixed."""
        front, front_spread, front_count = _local(image, (alpha > 1.0 - PURE) * near)
        behind, behind_spread, behind_count = _local(image, (alpha < PURE) * near)
        known = (front_count > SUPPORT) & (behind_count > SUPPORT) & (near > 0.0)
        a = alpha[..., None]
        variance = noise**2 + a.square() * front_spread + (1.0 - a).square() * behind_spread
        return Sides(alpha, front, behind, variance, (alpha > PURE) & (alpha < 1.0 - PURE) & known, curved)

    @property
    def mixed(self) -> Tensor:
        """(h, w, C), what the picture shows there if the contour is right."""
        return self.mixed_by(self.alpha)

    def mixed_by(self, alpha: Tensor) -> Tensor:
        """The same of another alpha (h, w)."""
        behind, step = self._radiances()
        mixed = behind + alpha[..., None] * step
        return linear_to_srgb(mixed.clamp(0.0, 1.0)) if self.curved else mixed

    def slope_by(self, alpha: Tensor) -> Tensor:
        """(h, w, C): the derivative of mixed_by() by alpha."""
        step = self._radiances()[1]
        return srgb_slope(self.mixed_by(alpha)) * step if self.curved else step

    def _radiances(self) -> tuple[Tensor, Tensor]:
        """Behind the contour, and the step from there to the object, both as they mix."""
        inside, outside = (
            (srgb_to_linear(self.inside), srgb_to_linear(self.outside)) if self.curved else (self.inside, self.outside)
        )
        return outside, inside - outside

    @property
    def contrast(self) -> Tensor:
        """(h, w): the difference of both sides, in standard deviations."""
        return ((self.inside - self.outside).square() / self.variance).sum(-1).sqrt()


def outlines_explained(parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> float:
    """The share, 0 … 1, of the contour that pictures show: of each image (h, w, C) in sRGB values, alpha (h, w), and the weights
    (h, w) of what lies around the object."""
    pairs, shown, length = [], 0.0, 0.0
    for image, alpha, near in parts:
        contour = smoothed(alpha[None], BLUR)[0]
        sides = Sides.of(image, contour, near)
        on = ((contour > PURE) & (contour < 1.0 - PURE)) * near
        length += float(on.sum())
        shown += float((on * (sides.contrast > CONTRAST) * sides.band).sum())
        pairs.append((sides.mixed, sides.mixed, image, (sides.band * near)[..., None]))
    return explained(pairs, softer=True) * min(1.0, shown / length / ALONE_SHOWN) if length > 0.0 else 0.0


def blur_losses(sides: Sides, image: Tensor, weight: Tensor, alpha: Tensor) -> Tensor:
    """(n,): half the robust squares of the differences of an image (h, w, C) from what `sides` mix, weighted (h, w), with alpha
    (h, w) blurred by each of BLURS: the tails of a blur show far in the values of a display, and one that is too wide puts bright
    contours too far out."""
    found = []
    for blur in BLURS:
        off = (sides.mixed_by(smoothed(alpha[None], blur)[0]) - image).square() / sides.variance
        squares = off.sum(-1)
        found.append(0.5 * (sides.band * weight * squares / (1.0 + squares / TOLERANCE)).sum())
    return torch.stack(found)


def noise_of_mask(mask: Tensor, factor: float) -> float:
    """Standard deviation of the mixed pixels of a mask (H, W) after its sides were multiplied by `factor`. One of zeros and ones
    says of a contour in a pixel only on which side of the middle it runs, which is off by 1/√12, evenly distributed; among the
    1/factor² pixels that become one, 1/factor lie on it."""
    between = (mask > PURE) & (mask < 1.0 - PURE)
    rows = mask[None, None]
    border = F.max_pool2d(rows, 3, 1, 1) + F.max_pool2d(-rows, 3, 1, 1) > 0.5
    if int(between.sum()) >= WHOLE * int(border.sum()):
        return NOISE
    return math.hypot(NOISE, min(1.0, factor) ** 1.5 / math.sqrt(12.0))


def outlined(image: Tensor, alpha: Tensor) -> Tensor:
    """An image (h, w, C), linear, with the contour of alpha (h, w, 1) drawn into it."""
    rim = F.max_pool2d(alpha.movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1) - alpha > RIM
    return torch.where(rim, image.new_tensor(OUTLINE if image.shape[-1] == 3 else [1.0] * image.shape[-1]), image)


def _local(image: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and variance (h, w, C) of the pixels around each that `share` (h, w) counts, and how many (h, w) of a window."""
    rows = image.movedim(-1, 0)
    count = smoothed(share.to(image)[None], REACH)[0]
    enough = count.clamp(min=1e-4)
    mean = smoothed(rows * share, REACH) / enough
    square = smoothed(rows.square() * share, REACH) / enough
    return mean.movedim(0, -1), (square - mean.square()).clamp(min=0.0).movedim(0, -1), count
