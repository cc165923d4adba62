"""A photograph at one resolution."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ....camera.camera import Camera
from ....files.image import linear_to_srgb
from ...contour_colors import PIXEL_NOISE, mask_noise
from ...views import area_mean
from ..task import TargetView


@dataclass(frozen=True)
class Picture:
    """A picture to compare renders with. `display` has sRGB values, in which noise, blur and compression of photographs are
    nearly uniform."""

    camera: Camera
    radiance: Tensor  # (h, w, C), linear; white is 1
    display: Tensor  # (h, w, C)
    mask: Tensor | None  # (h, w), 1 on the object
    weight: Tensor  # (h, w)
    depth: Tensor | None  # (h, w), NaN where it was not measured
    noise: float = PIXEL_NOISE  # standard deviation of mixed pixels of `outlined`

    @staticmethod
    def from_shot(shot: TargetView, masked: bool, depth: Tensor | None, size: tuple[int, int]) -> Picture:
        """Return the picture of a shot; `masked`: its last channel is a mask."""
        radiance, mask = area_mean(shot.target, size), None
        if masked:
            radiance, mask = radiance[..., :-1], radiance[..., -1].clamp(0.0, 1.0)
        weight = torch.ones(size, dtype=torch.float32) if shot.weight is None else area_mean(shot.weight, size)[..., 0]
        noise = PIXEL_NOISE if mask is None else mask_noise(shot.target[..., -1], size[0] / shot.target.shape[0])
        nearest = None if depth is None else F.interpolate(depth[None, None], size, mode="nearest-exact")[0, 0]
        return Picture(
            shot.camera.resized(size), radiance, linear_to_srgb(radiance.clamp(0.0, 1.0)), mask, weight, nearest, noise
        )

    @property
    def size(self) -> tuple[int, int]:
        """The size (h, w)."""
        return self.camera.size

    def part(self, rows: slice, columns: slice, camera: Camera) -> Picture:
        """Return the part in such rows and columns, which the camera sees."""
        mask, depth = (None if one is None else one[rows, columns] for one in (self.mask, self.depth))
        radiance, display, weight = (one[rows, columns] for one in (self.radiance, self.display, self.weight))
        return Picture(camera, radiance, display, mask, weight, depth, self.noise)

    @property
    def outlined(self) -> Tensor:
        """The channels (h, w, c) that show the outline of the object: the mask, or else the colours."""
        return self.display if self.mask is None else self.mask[..., None]
