"""The colours on both sides of a contour, and their mixture across it.

A pixel that is covered by the share α shows α F + (1 − α) B, with the radiances F of the object and B of what is behind it. F
and B are means of the picture a little inside and a little outside, and vary there by their textures. Lenses and sensors mix
radiance, and the display's curve comes after: half of white and half of black is 0.73 in sRGB values. Mixing sRGB values would
put contours on the dark side of edges, by 0.1 … 0.2 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..files.image import linear_to_srgb, srgb_slope, srgb_to_linear
from .edge_support import edge_support
from .region import smoothed

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


@dataclass(frozen=True)
class ContourColors:
    """The colours on both sides of a contour, the 0.5 level of a blurred alpha (h, w)."""

    alpha: Tensor  # (h, w)
    inside: Tensor  # (h, w, C)
    outside: Tensor
    variance: Tensor  # (h, w, C) of their mixture
    band: Tensor  # (h, w) bool: mixed pixels whose sides are both known
    curved: bool = True  # sRGB values, which mix as radiance; a mask's values mix as they are

    @staticmethod
    def from_image(
        image: Tensor, alpha: Tensor, near: Tensor, curved: bool = True, noise: float = PIXEL_NOISE
    ) -> ContourColors:
        """Measure the colours in an image (h, w, C) of sRGB values, or in a mask with `curved` False. `near` (h, w) says which
        pixels may be used; `noise` is the standard deviation of a mixed pixel."""
        front, front_spread, front_count = _local(image, (alpha > 1.0 - PURE) * near)
        behind, behind_spread, behind_count = _local(image, (alpha < PURE) * near)
        known = (front_count > SUPPORT) & (behind_count > SUPPORT) & (near > 0.0)
        a = alpha[..., None]
        variance = noise**2 + a.square() * front_spread + (1.0 - a).square() * behind_spread
        return ContourColors(alpha, front, behind, variance, (alpha > PURE) & (alpha < 1.0 - PURE) & known, curved)

    @property
    def mixed(self) -> Tensor:
        """The mixture (h, w, C), which the picture shows if the contour is right."""
        return self.mixed_by(self.alpha)

    def mixed_by(self, alpha: Tensor) -> Tensor:
        """Return the mixture (h, w, C) by another alpha (h, w)."""
        behind, step = self._radiances()
        mixed = behind + alpha[..., None] * step
        return linear_to_srgb(mixed.clamp(0.0, 1.0)) if self.curved else mixed

    def slope_by(self, alpha: Tensor) -> Tensor:
        """Return the derivative (h, w, C) of mixed_by() by alpha."""
        step = self._radiances()[1]
        return srgb_slope(self.mixed_by(alpha)) * step if self.curved else step

    def _radiances(self) -> tuple[Tensor, Tensor]:
        """Return the radiance behind the contour, and the step from there to the object's."""
        inside, outside = (
            (srgb_to_linear(self.inside), srgb_to_linear(self.outside)) if self.curved else (self.inside, self.outside)
        )
        return outside, inside - outside

    @property
    def contrast(self) -> Tensor:
        """The difference (h, w) of both sides, in standard deviations."""
        return ((self.inside - self.outside).square() / self.variance).sum(-1).sqrt()


def contour_support(parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> float:
    """Return the share, 0 … 1, of the contour that pictures show. A part is an image (h, w, C) in sRGB values, its alpha (h,
    w), and the weights (h, w) of the pixels near the object."""
    pairs, shown, length = [], 0.0, 0.0
    for image, alpha, near in parts:
        contour = smoothed(alpha[None], CONTOUR_BLUR)[0]
        sides = ContourColors.from_image(image, contour, near)
        on = ((contour > PURE) & (contour < 1.0 - PURE)) * near
        length += float(on.sum())
        shown += float((on * (sides.contrast > CONTRAST) * sides.band).sum())
        pairs.append((sides.mixed, sides.mixed, image, (sides.band * near)[..., None]))
    return edge_support(pairs, softer=True) * min(1.0, shown / length / ALONE_SHOWN) if length > 0.0 else 0.0


def blur_losses(sides: ContourColors, image: Tensor, weight: Tensor, alpha: Tensor) -> Tensor:
    """Return for each of CONTOUR_BLURS half the robust squared differences of an image (h, w, C) from the mixture, with alpha
    (h, w) blurred by it, weighted (h, w). The tails of a blur show far in sRGB values, so one that is too wide puts bright
    contours too far out."""
    found = []
    for blur in CONTOUR_BLURS:
        off = (sides.mixed_by(smoothed(alpha[None], blur)[0]) - image).square() / sides.variance
        squares = off.sum(-1)
        found.append(0.5 * (sides.band * weight * squares / (1.0 + squares / TOLERANCE)).sum())
    return torch.stack(found)


def mask_noise(mask: Tensor, factor: float) -> float:
    """Return the standard deviation of the mixed pixels of a mask (H, W) whose sides were multiplied by `factor`. A mask of
    zeros and ones only says on which side of a pixel's middle the contour runs. This is off by 1/√12, evenly distributed,
    and of the 1/factor² pixels that become one, 1/factor lie on the contour."""
    between = (mask > PURE) & (mask < 1.0 - PURE)
    rows = mask[None, None]
    border = F.max_pool2d(rows, 3, 1, 1) + F.max_pool2d(-rows, 3, 1, 1) > 0.5
    if int(between.sum()) >= MIN_MIXED * int(border.sum()):
        return PIXEL_NOISE
    return math.hypot(PIXEL_NOISE, min(1.0, factor) ** 1.5 / math.sqrt(12.0))


def draw_contour(image: Tensor, alpha: Tensor) -> Tensor:
    """Draw the contour of alpha (h, w, 1) into a linear image (h, w, C)."""
    contour = F.max_pool2d(alpha.movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1) - alpha > CONTOUR_STEP
    return torch.where(contour, image.new_tensor(OUTLINE if image.shape[-1] == 3 else [1.0] * image.shape[-1]), image)


def _local(image: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean and variance (h, w, C) of the pixels in each pixel's window, weighted by `share` (h, w), and its weight (h,
    w)."""
    rows = image.movedim(-1, 0)
    count = smoothed(share.to(image)[None], COLOUR_WINDOW)[0]
    enough = count.clamp(min=1e-4)
    mean = smoothed(rows * share, COLOUR_WINDOW) / enough
    square = smoothed(rows.square() * share, COLOUR_WINDOW) / enough
    return mean.movedim(0, -1), (square - mean.square()).clamp(min=0.0).movedim(0, -1), count
