"""Points of lights from which edges cast shadows, for the samples on the borders of these."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ._derivatives import moves
from ._mesh_light import MeshLight
from ._samples import LightRows
from ._seeds import STEPS, mixed_bits, signed
from ._surfaces import Surfaces
from .lights import Light, LightPoints

MANY = 1024  # points that stand for a light with an extent, other ones with each seed


class ShadowLight(NamedTuple):
    """A light as edges see it."""

    number: int  # in scene.casting
    light: Light
    points: LightPoints

    @classmethod
    def of(cls, surfaces: Surfaces, index: int, seed: int) -> ShadowLight:
        light = surfaces.scene.casting[index]
        points = light.draw(_even(1 if light.punctual else MANY, seed).to(surfaces.verts.device))
        # Neighbours follow one another, for edges are asked before parts of a light.
        with torch.no_grad():
            return cls(index, light, points.select(z_order(light.place(points))))

    @staticmethod
    def moves(light: Light) -> bool:
        """Whether the place of one of its points may be differentiated."""
        return moves(light.place(light.draw(torch.zeros((1, 3), dtype=torch.float64))))

    @property
    def place(self) -> Tensor:
        """(K, 3) float64, differentiable: where its points are, or the unit directions towards them."""
        return self.light.place(self.points).double()

    def rows(self, surfaces: Surfaces) -> LightRows:
        """As the kernel reads them."""
        place = self.place.detach().cpu()
        count = len(place)
        return LightRows(
            place,
            torch.full((count,), int(self.light.infinite), dtype=torch.uint8),
            self._power(),
            self._faces(surfaces),
            torch.tensor([0, count]),
        )

    def _power(self) -> Tensor:
        """(K,) float64: what a point gives on the mean at the distance one, or from infinity."""
        if self.light.punctual:
            return torch.ones(1, dtype=torch.float64)
        with torch.no_grad():
            axes = [torch.zeros(3)] if self.light.infinite else [*torch.eye(3), *-torch.eye(3)]
            power = torch.zeros(len(self.points.index), dtype=torch.float64)
            for axis in axes:
                at = (0 if self.light.infinite else self.place) + axis.to(self.points.uv)
                at = at.expand(len(power), 3)
                power += self.light.arriving(self.points, at).double().abs().mean(1).cpu()
            return power / len(axes)

    def _faces(self, surfaces: Surfaces) -> Tensor:
        """(K,) int32: the faces of the scene that they lie on, −1 for none."""
        if not isinstance(self.light, MeshLight):
            return torch.full((len(self.points.index),), -1, dtype=torch.int32)
        mesh = next(i for i, mesh in enumerate(surfaces.scene.meshes) if mesh is self.light.mesh)
        return (self.points.index + surfaces.first_faces[mesh]).int().cpu()


def z_order(place: Tensor) -> Tensor:
    """(K,) int64: places (K, 3) in the order of a Z-curve through the cube around them (Morton 1966)."""
    low, high = place.amin(0), place.amax(0)
    size = (high - low).amax()
    cell = ((place - low) / torch.where(size > 0, size, 1.0) * 1023.99).long()
    code = torch.zeros(len(place), dtype=torch.int64, device=place.device)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort()


def _even(count: int, seed: int) -> Tensor:
    """(count, 3) float64 in [0, 1), moved at random: the first ascends in equal steps, the others follow a sequence that fills
    the unit square evenly (Roberts 2018)."""
    shift = [(mixed_bits(mixed_bits(seed) + k) >> 11) * 2.0**-53 for k in range(3)]
    rows = torch.arange(count)
    columns = [(rows.double() + shift[0]) / count]
    for k in (1, 2):
        bits = rows * STEPS[k] + signed(mixed_bits(seed * 3 + k))
        columns.append(((bits >> 11) & ((1 << 53) - 1)).double() * 2.0**-53)
    return torch.stack(columns, 1).clamp(max=1 - 2.0**-53)
