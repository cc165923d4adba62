"""Shadow rays from points of surfaces to points of lights: where they end, and which need not be cast."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..scene.lights import Light, LightPoints
from .surfaces import Surfaces

# Where a ray meets a thin face, its rounding error is many times the spacing of doubles: a light must not hide itself.
LEAST_ROUNDING = 2.0**-40


class Forced(NamedTuple):
    """The points of one light, and whether they are seen, given for some hits instead of drawn and traced."""

    light: int  # place in scene.casting
    points: LightPoints  # N of them
    lit: Tensor  # (N,) 0 or 1
    some: Tensor  # (N,) bool: for which hits; for the others light points are drawn, and shadow rays cast
    only: bool = False  # whether only the radiance that this light adds is wanted

    def select(self, index: Tensor | slice) -> Forced:
        return Forced(self.light, self.points.select(index), self.lit[index], self.some[index], self.only)

    def among(self, drawn: LightPoints) -> LightPoints:
        """These where `some` says so, those that were drawn elsewhere."""
        return LightPoints(
            torch.where(self.some, self.points.index, drawn.index),
            torch.where(self.some[:, None], self.points.uv, drawn.uv),
            torch.where(self.some, self.points.density, drawn.density),
        )


def seen_from(light: Light, points: LightPoints, surfaces: Surfaces, here: Tensor) -> tuple[Tensor, Tensor]:
    """Where shadow rays from `here` (N, 3) end, (N, 3) float64, and (N,) the distance from either end within which nothing hides
    the light: sixteen times the spacing of the coordinates. Rays to a light at infinity end outside a ball around the scene."""
    place = light.place(points).detach().to(surfaces.verts.device, torch.float64)
    spacing = torch.finfo(surfaces.verts.dtype).eps
    size = here.abs().amax(1)
    if light.infinite:
        center, radius = surfaces.ball
        return here + place * ((here - center).norm(dim=1, keepdim=True) + 1.01 * radius), 16 * spacing * size
    size = torch.maximum(size, place.abs().amax(1))
    return place, 16 * (spacing if light.punctual else max(spacing, LEAST_ROUNDING)) * size
