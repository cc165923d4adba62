"""Pictures of depth, normals and positions that sensors or other renderers made, and how a render is compared with them.

A render's channels are multiplied by its alpha a, and so is the picture before it is compared: r = c − a m, of the channel c and
the measured m. At a silhouette r then jumps by the difference of two depths, not by the depth itself, so that it does not
matter from where depths are counted; where the render shows nothing, r is zero. That what was measured is covered says a term
of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..camera.camera import Camera
from ..check import as_tensor, check_float, check_positive, check_shape

# By argument: the channel of render_aovs(), and its width.
CHANNELS = {"depths": ("depth", 1), "normals": ("shading_normal", 3), "positions": ("position", 3)}
NORMAL_SCALE = 0.1  # of normals, some 6°
MAD = 1.4826  # standard deviations of Gaussian noise in a median of its sizes


@dataclass(frozen=True, eq=False)
class Measured:
    """Pictures of depth, normals or positions, and how far to trust them.

    values   for each camera (H, W) or (H, W, c), or None where it has none; NaN, ±∞ and 0 (of normals and positions: all three 0)
             are not measured
    weights  for each camera (H, W) or (H, W, 1), from 0, how much a pixel counts: a sensor's confidence, or 0 where it is wrong.
             None: 1
    factor   how much all of it counts beside masks and colours
    scale    what a residual of noise alone may be, in the pictures' units: residuals much larger are taken for outliers once
             most are small. None: what a pixel covers at the object, and for normals 0.1
    """

    values: Any
    weights: Any = None
    factor: float = 1.0
    scale: float | None = None

    def __post_init__(self) -> None:
        check_positive("factor", self.factor, least=0.0, most=1e9)
        if self.scale is not None:
            check_positive("scale", self.scale, least=1e-30, most=1e30)


@dataclass(frozen=True, eq=False)
class Measurement:
    """One picture of one channel."""

    value: Tensor  # (H, W, c), zero where nothing was measured
    weight: Tensor  # (H, W, 1), zero there too
    factor: float
    scale: float

    def resized(self, size: tuple[int, int]) -> Measurement:
        """Means over larger pixels of what was measured in them; where less than half of a pixel was, it is not."""
        weight = _area_mean(self.weight, size)
        seen = _area_mean((self.weight > 0).to(self.weight), size)
        value = _area_mean(self.value * self.weight, size) / weight.clamp(min=1e-30)
        known = (seen >= 0.5) & (weight > 0)
        grown = (self.value.shape[0] * self.value.shape[1] / (size[0] * size[1])) ** 0.5
        scale = self.scale if self.value.shape[-1] == 3 and self.is_direction else self.scale * grown
        return replace(self, value=value * known, weight=weight * known, scale=scale)

    @property
    def is_direction(self) -> bool:
        return bool((self.value.norm(dim=-1) < 1.0 + 1e-3).all())


def _area_mean(image: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(image.movedim(-1, 0)[None], size=size, mode="area")[0].movedim(0, -1)


def apart(render: Tensor, alpha: Tensor, given: Sequence[Measurement]) -> Tensor:
    """The loss of renders (B, H, W, c) with alpha (B, H, W, 1): the mean over all pixels of Geman and McClure's
    2x² / (x² + 4), x = |r| / s, times s / scale."""
    value, weight = torch.stack([m.value for m in given]), torch.stack([m.weight for m in given])
    square = (render - alpha * value).square().sum(-1, keepdim=True)
    scale = given[0].scale
    with torch.no_grad():
        seen = (weight > 0) & (alpha > 0.5)
        typical = MAD * float(square[seen].median().sqrt()) if bool(seen.any()) else scale
    s = max(scale, typical)
    x2 = square / s**2
    return given[0].factor * (s / scale) * (weight * 2.0 * x2 / (x2 + 4.0)).mean()
