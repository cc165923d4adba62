"""The light of a film's pictures so far, and what covers the object in the next.

Where a picture is not what the mesh is in that light, something covers it. The light of that picture alone would follow what
covers the object, so the light is learnt slowly, from pictures that show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ....camera.camera import Camera
from ....files.image import linear_to_srgb, srgb_to_linear
from .cover import LEAST, OFF, covered, weighted
from .level import PhotoLevel, Seen
from .light import Lit, spherical
from .views import Views

RATE = 0.1  # of a picture, in the light of all


class Cover(NamedTuple):
    """What covers the object in a picture."""

    weight: Tensor  # (h, w): of a pixel, near zero where it is covered
    share: float  # of the object that is

    def left_out(self, level: PhotoLevel) -> PhotoLevel:
        """Of one picture, of any size."""
        return weighted(level, [self.weight])


class Remembered:
    """The light of the pictures so far."""

    def __init__(self) -> None:
        self.light: Tensor | None = None  # coefficients (C, n)
        self.deviation = 0.0  # of pictures from what they predict, as Lit has it

    def learn(self, views: Sequence[Seen]) -> None:
        """Takes in the light of a picture that shows the object."""
        for seen in views:
            if seen.lit is not None:
                rate = RATE if self._knows(seen.lit) else 1.0
                light = self.light if self.light is not None and rate < 1.0 else seen.lit.coefficients
                self.light = (1.0 - rate) * light + rate * seen.lit.coefficients
                self.deviation = (1.0 - rate) * self.deviation + rate * seen.lit.deviation

    def cover(self, views: Sequence[Seen]) -> Cover | None:
        """What covers the object in a picture, if it is at the pose that is seen; None where no light is known."""
        (seen,) = views
        if seen.lit is None or self.light is None or not self._knows(seen.lit):
            return None
        inside = seen.lit.surface.inside
        hidden = covered(seen.lit, self.light, OFF * self.deviation)
        weight = torch.ones_like(seen.alpha)
        weight[seen.box][hidden] = LEAST
        return Cover(weight, float(hidden[inside].float().mean()))

    def shone_on(self, views: Views, camera: Camera) -> Views:
        """The views, in the light."""
        if self.light is None:
            return views
        world = camera.world_to_camera[:3, :3].double().T @ views.rotations
        Y = spherical(torch.einsum("nij,nhwj->nhwi", world.float(), views.normals))[..., : self.light.shape[1]]
        radiance = srgb_to_linear(views.colours) * (Y @ self.light.T)
        return replace(views, colours=linear_to_srgb(radiance.clamp(0.0, 1.0)))

    def _knows(self, lit: Lit) -> bool:
        return self.light is not None and self.light.shape == lit.coefficients.shape
