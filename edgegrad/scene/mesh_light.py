"""Meshes that emit, as lights: points of their faces."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from .appearance import OnMesh, coordinates
from .environment import UNIFORM_SHARE, pick
from .lights import Light, LightPoints
from .material import Texture
from .mesh import Mesh
from .rows import areas, dot, unit
from .texel_edges import TexelEdges


class MeshLight(Light):
    """A mesh whose material has emission."""

    punctual = False

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._texel_edges: tuple[TexelEdges | None] | None = None  # once they were asked for

    def __repr__(self) -> str:
        return f"MeshLight({self.mesh!r})"

    def _emission(self, face: Tensor, b: Tensor) -> Tensor:
        material = self.mesh.material
        assert material is not None and material.emission is not None
        return OnMesh(self.mesh, face, b).value(material.emission)

    def _area(self, face: Tensor) -> Tensor:
        """Return normals (N, 3) float64 of faces, as long as their areas."""
        return areas(self.mesh.verts[self.mesh.faces[face].long()]) / 2

    @cached_property
    def _powers(self) -> tuple[Tensor, Tensor]:
        """Return (F,) float64 areas of faces, and areas times the mean magnitude of what they emit."""
        with torch.no_grad():
            face = torch.arange(len(self.mesh.faces), device=self.mesh.verts.device)
            area = self._area(face).norm(dim=1)
            total: Tensor = torch.zeros((), dtype=torch.float64)
            for b in ((1.0, 1.0, 1.0), (4.0, 1.0, 1.0), (1.0, 4.0, 1.0), (1.0, 1.0, 4.0)):
                weights = torch.tensor(b, dtype=self.mesh.verts.dtype, device=self.mesh.verts.device).expand(
                    len(face), 3
                )
                total = total + self._emission(face, weights / sum(b)).double().abs().mean(1)
            return area, area * total / 4

    @cached_property
    def _table(self) -> tuple[Tensor, Tensor]:
        """Return the running sum (F,) float64 of the probabilities of faces, and their pdf by area."""
        with torch.no_grad():
            area, power = self._powers
            share = area / area.sum() if float(area.sum()) > 0 else torch.full_like(area, 1 / len(area))
            chance = (
                (1 - UNIFORM_SHARE) * power / power.sum() + UNIFORM_SHARE * share if float(power.sum()) > 0 else share
            )
            return chance.cumsum(0), torch.where(area > 0, chance / torch.where(area > 0, area, 1.0), 0.0)

    @cached_property
    def mean_emission(self) -> Tensor:
        """Return the mean magnitude () float64 over the area."""
        return self._powers[1].sum() / self._powers[0].sum().clamp(min=1e-300)

    @property
    def density(self) -> Tensor:
        """Return the pdf by area (F,) float64 with which points are drawn on each face."""
        return self._table[1]

    @property
    def chance(self) -> Tensor:
        """Return the probability (F,) float64 that a point is drawn on a face."""
        running = self._table[0]
        return running.diff(prepend=running.new_zeros(1))

    def draw(self, u: Tensor) -> LightPoints:
        running, density = self._table
        face, within = pick(running, u[:, 0])
        # Uniform in a triangle (Turk 1990).
        root, v = within.sqrt(), u[:, 1].double()
        uv = torch.stack([root * (1 - v), root * v], 1)
        return LightPoints(face, uv, density[face])

    def _weights(self, points: LightPoints) -> Tensor:
        """Return barycentrics (N, 3) float64."""
        return torch.cat([1 - points.uv.sum(1, keepdim=True), points.uv], 1).to(self.mesh.verts.device)

    def shows(self, points: LightPoints) -> Tensor:
        return OnMesh(self.mesh, points.index, self._weights(points)).shows()

    def place(self, points: LightPoints) -> Tensor:
        return self._at(points.index, self._weights(points))

    def _at(self, face: Tensor, weights: Tensor) -> Tensor:
        # Positions are double, because a point rounded to floats would lie behind its own face half of the time.
        corners = self.mesh.verts[self.mesh.faces[face].long()].double()
        return (weights[:, :, None] * corners).sum(1)

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        """Return L cos θ / r², over the pdf. Barycentrics stay while the faces move, so areas that grow count more."""
        material = self.mesh.material
        assert material is not None
        weights = self._weights(points)
        radiance = self._emission(points.index, weights.to(self.mesh.verts))
        density = points.density[:, None]
        drawn = density > 0
        facing = self.facing(points.index, weights, position) / torch.where(drawn, density, 1.0)
        return torch.where(drawn, radiance * facing, 0.0).to(position)

    def facing(self, face: Tensor, weights: Tensor, position: Tensor) -> Tensor:
        """Return cos θ / r² (N, 1) float64 from places on faces, of barycentrics `weights` (N, 3), to `position` (N, 3). It is
        multiplied by how many times as large as now the faces become. It is zero from behind, unless the material is two-sided,
        and of a face without area."""
        material = self.mesh.material
        assert material is not None
        normal = self._area(face)
        away = position.double() - self._at(face, weights)
        squared = (away * away).sum(1, keepdim=True)
        area = normal.detach().norm(dim=1, keepdim=True)
        some = (squared > 0) & (area > 0)
        cosine = dot(normal, unit(away))[:, None] / torch.where(some, area, 1.0)
        cosine = cosine.abs() if material.two_sided else cosine.clamp(min=0)
        return torch.where(some, cosine / torch.where(some, squared, 1.0), 0.0)

    @property
    def texture(self) -> Texture | None:
        emission = None if self.mesh.material is None else self.mesh.material.emission
        return emission if isinstance(emission, Texture) else None

    @property
    def has_texel_edges(self) -> bool:
        """Return whether its emission is that of the nearest texel."""
        return self.texture is not None and self.texture.filter == "nearest"

    @property
    def coordinates(self) -> Tensor:
        return coordinates(self.mesh, self.texture)[0]

    def texel_edges(self, u: tuple[float, float]) -> TexelEdges | None:
        """Return the texel edges of its emission, where there are jumps; u picks some of too many, the first
        time."""
        if self._texel_edges is None:
            assert self.texture is not None
            with torch.no_grad():
                face = torch.arange(len(self.mesh.faces), device=self.mesh.verts.device)
                self._texel_edges = (TexelEdges.from_mesh(self.mesh, self.texture, self._area(face).norm(dim=1), u),)
        return self._texel_edges[0]
