"""The colours on both sides of a contour, and their mixture across it.

A pixel that is covered by the share α shows α F + (1 − α) B, with the radiances F of the object and B of what is behind it. F
and B are means of the picture a little inside and a little outside, and vary there by their textures. Lenses and sensors mix
radiance, and the display's curve comes after: half of white and half of black is 0.73 in sRGB values. Mixing sRGB values would
put contours on the dark side of edges, by 0.1 … 0.2 pixels.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from .region import smoothed

COLOUR_WINDOW = 2.0  # standard deviation in pixels of the windows from which colours are taken
PURE = 0.03  # largest share of the other side in a pixel that counts as one side alone
SUPPORT = 0.03  # least weight of a window
CONTOUR_BLURS = 0.3, 0.5, 0.7, 0.9  # pixels, of one picture's alpha; wider ones pass for an offset of the contour
TOLERANCE = 12.0  # squared differences in variances; far larger ones hardly count (Geman and McClure 1987)
CONTRAST = 2.0  # standard deviations between the sides of a visible contour
# Share of the contour that must be visible where nothing else is compared; below it, edge support falls in proportion. Wrong
# places in clutter show 0.5 … 0.7, right ones 0.85 and more.
ALONE_SHOWN = 0.85
# Bits per pixel that colours next to such a contour must hold; below it, edge support falls in proportion. Fits find up to 0.36
# in clutter, up to 0.45 on another object's contour, and mostly 0.48 … 0.9 where the object is.
ALONE_INFORMATION = 0.48
OUTLINE = 1.0, 0.8, 0.0  # linear radiance
MIN_MIXED = 0.1  # of the pixels along a mask's border; a mask with fewer mixed ones is of zeros and ones
CONTOUR_STEP = 0.3  # of alpha between neighbours, where a contour is drawn


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
