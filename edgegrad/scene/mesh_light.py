"""Meshes that emit, as lights: points of their faces."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import normalize

from .appearance import OnMesh
from .environment import EVEN, pick
from .lights import Light, LightPoints
from .mesh import Mesh


class MeshLight(Light):
    """A mesh whose material has emission."""

    punctual = False

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def __repr__(self) -> str:
        return f"MeshLight({self.mesh!r})"

    def _emission(self, face: Tensor, b: Tensor) -> Tensor:
        material = self.mesh.material
        assert material is not None and material.emission is not None
        return OnMesh(self.mesh, face, b).value(material.emission)

    def _area(self, face: Tensor) -> Tensor:
        """(N, 3) normals of faces, as long as their areas."""
        corner = self.mesh.verts[self.mesh.faces[face].long()]
        return torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2

    @cached_property
    def _table(self) -> tuple[Tensor, Tensor]:
        """(F,) float64: the running sum of the probabilities of faces, and their densities by area."""
        with torch.no_grad():
            face = torch.arange(len(self.mesh.faces), device=self.mesh.verts.device)
            area = self._area(face).double().norm(dim=1)
            total: Tensor = torch.zeros((), dtype=torch.float64)
            for b in ((1.0, 1.0, 1.0), (4.0, 1.0, 1.0), (1.0, 4.0, 1.0), (1.0, 1.0, 4.0)):
                weights = torch.tensor(b, dtype=self.mesh.verts.dtype, device=self.mesh.verts.device).expand(
                    len(face), 3
                )
                total = total + self._emission(face, weights / sum(b)).double().abs().mean(1)
            power = area * total
            share = area / area.sum() if float(area.sum()) > 0 else torch.full_like(area, 1 / len(area))
            chance = (1 - EVEN) * power / power.sum() + EVEN * share if float(power.sum()) > 0 else share
            return chance.cumsum(0), torch.where(area > 0, chance / torch.where(area > 0, area, 1.0), 0.0)

    @property
    def density(self) -> Tensor:
        """(F,) float64, by area, with which points are drawn on each face."""
        return self._table[1]

    @property
    def chance(self) -> Tensor:
        """(F,) float64 that a point is drawn on a face."""
        running = self._table[0]
        return running.diff(prepend=running.new_zeros(1))

    def draw(self, u: Tensor) -> LightPoints:
        running, density = self._table
        face = pick(running, u[:, 0])
        # Uniform in a triangle (Turk 1990).
        root = u[:, 1].double().sqrt()
        uv = torch.stack([root * (1 - u[:, 2]), root * u[:, 2]], 1)
        return LightPoints(face, uv, density[face])

    def _weights(self, points: LightPoints) -> Tensor:
        """(N, 3) float64."""
        return torch.cat([1 - points.uv.sum(1, keepdim=True), points.uv], 1).to(self.mesh.verts.device)

    def place(self, points: LightPoints) -> Tensor:
        # In double: where the rest of the scene is, a point rounded to floats would lie behind its own face half of the time.
        corners = self.mesh.verts[self.mesh.faces[points.index].long()].double()
        return (self._weights(points)[:, :, None] * corners).sum(1)

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        """L cos θ / r², over the density. Barycentrics stay while the faces move, so areas that grow count more."""
        material = self.mesh.material
        assert material is not None
        radiance = self._emission(points.index, self._weights(points).to(self.mesh.verts)).to(position)
        normal = self._area(points.index).to(position)
        away = position - self.place(points).to(position)
        squared = (away * away).sum(1, keepdim=True)
        apart = squared > 0
        squared = torch.where(apart, squared, 1.0)
        # The normal is as long as the area: over its value, the cosine times the Jacobian of the barycentrics.
        area = normal.detach().norm(dim=1, keepdim=True)
        facing = (normal * normalize(away, dim=1)).sum(1, keepdim=True)
        facing = facing.abs() if material.two_sided else facing.clamp(min=0)
        per_density = points.density[:, None].to(area) * area
        some = apart & (per_density > 0)
        return torch.where(some, radiance * facing / (squared * torch.where(some, per_density, 1.0)), 0.0)
