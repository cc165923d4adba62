"""The light of a film's pictures so far, and occluders in the next.

Something covers the object where a picture differs from the mesh in that light. The light of that picture alone would follow
the occluder, so the light is learnt slowly, from pictures that show the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ....camera.camera import Camera
from ....files.image import linear_to_srgb, srgb_to_linear
from .level import PhotoLevel, PictureComparison
from .light import FittedLight, harmonics_of
from .occluders import OCCLUDED_DEVIATIONS, OCCLUDED_WEIGHT, occluded, weighted
from .template_views import TemplateViews

LIGHT_RATE = 0.1  # weight of a picture in the light of all


class Occluder(NamedTuple):
    """Something unknown that covers the object in a picture."""

    weight: Tensor  # (h, w), near zero where the object is occluded
    share: float  # occluded share of the object

    def left_out(self, level: PhotoLevel) -> PhotoLevel:
        """Return the level, of one picture of any size, without it."""
        return weighted(level, [self.weight])


class LightHistory:
    """The light of the pictures so far."""

    def __init__(self) -> None:
        self.light: Tensor | None = None  # (C, n)
        self.deviation = 0.0  # of pictures from what they predict, as FittedLight has it

    def learn(self, views: Sequence[PictureComparison]) -> None:
        """Take in the light of a picture that shows the object."""
        for seen in views:
            if seen.lit is not None:
                rate = LIGHT_RATE if self._knows(seen.lit) else 1.0
                light = self.light if self.light is not None and rate < 1.0 else seen.lit.coefficients
                self.light = (1.0 - rate) * light + rate * seen.lit.coefficients
                self.deviation = (1.0 - rate) * self.deviation + rate * seen.lit.deviation

    def occluder(self, views: Sequence[PictureComparison]) -> Occluder | None:
        """Return what covers the object in a picture, if its pose is right; None where no light is known."""
        (seen,) = views
        if seen.lit is None or self.light is None or not self._knows(seen.lit):
            return None
        inside = seen.lit.surface.inside
        hidden = occluded(seen.lit, self.light, OCCLUDED_DEVIATIONS * self.deviation)
        weight = torch.ones_like(seen.alpha)
        weight[seen.box][hidden] = OCCLUDED_WEIGHT
        return Occluder(weight, float(hidden[inside].float().mean()))

    def illuminated(self, views: TemplateViews, camera: Camera) -> TemplateViews:
        """Return the views in the light."""
        if self.light is None:
            return views
        world = camera.world_to_camera[:3, :3].double().T @ views.rotations
        Y = harmonics_of(torch.einsum("nij,nhwj->nhwi", world.float(), views.normals))[..., : self.light.shape[1]]
        radiance = srgb_to_linear(views.colors) * (Y @ self.light.T)
        return replace(views, colors=linear_to_srgb(radiance.clamp(0.0, 1.0)))

    def _knows(self, lit: FittedLight) -> bool:
        return self.light is not None and self.light.shape == lit.coefficients.shape
