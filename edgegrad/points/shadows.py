"""Lights as points or triangles, for the samples on the boundaries of their shadows."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..scene.environment import Environment, pick
from ..scene.lights import Light, LightPoints
from ..scene.mesh_light import MeshLight
from .records import LightParts, barycentrics
from .seeds import STEPS, mixed_bits, signed
from .surfaces import Surfaces

MOST_FACES = 4096  # of an emissive mesh: if it has more, so many are drawn with each seed
DIRECTIONS = 1 << 14  # drawn from an environment, to find where it is bright
LEAST_PARTS_OF_ENVIRONMENT = 12  # no part of an environment holds more than one in so many of these


class ShadowLight(NamedTuple):
    """A light, and its parts."""

    number: int  # in scene.casting
    light: Light
    parts: LightParts
    faces: Tensor  # (L,) int64 of an emissive mesh that the parts are

    @classmethod
    def from_surfaces(cls, surfaces: Surfaces, index: int, seed: int) -> ShadowLight:
        light = surfaces.scene.casting[index]
        with torch.no_grad():
            if isinstance(light, MeshLight):
                mesh = next(i for i, mesh in enumerate(surfaces.scene.meshes) if mesh is light.mesh)
                parts, faces = _of_mesh(light, surfaces.first_faces[mesh], seed)
            else:
                u = _even(1 if light.punctual else DIRECTIONS, seed).to(surfaces.verts.device)
                place = light.place(light.draw(u)).double().cpu()
                corner, chance = (place.expand(1, 3, 3), torch.ones(1)) if light.punctual else triangles_of(place)
                faces = torch.full((len(corner),), -1)
                parts = LightParts(corner, chance.double(), faces.int(), light.infinite, not light.punctual, True)
        return cls(index, light, parts, faces)

    @staticmethod
    def moves(light: Light) -> bool:
        """Return whether the place of one of its points may be differentiated."""
        return moves(light.place(light.draw(torch.zeros((1, 2), dtype=torch.float64))))

    def points(self, part: Tensor, uv: Tensor) -> tuple[LightPoints, Tensor]:
        """Return the points at the last two barycentrics uv (N, 2) of parts (N,), and (N,) the light's own pdf of points over
        that by which the kernel draws them."""
        one = uv.new_ones(len(uv))
        if isinstance(self.light, MeshLight):
            face = self.faces.to(part.device)[part]
            return LightPoints(face, uv, self.light.density[face]), one
        if not isinstance(self.light, Environment):
            return self.light.draw(torch.zeros((len(uv), 2), dtype=torch.float64, device=uv.device)), one
        corner = self.parts.corner.to(uv.device)
        direction = (barycentrics(uv)[:, :, None] * corner[part]).sum(1)
        points = self.light.points_at(torch.nn.functional.normalize(direction, dim=1))
        # A triangle of area A seen at the distance r has the solid angle A cos θ / r².
        angle = torch.linalg.det(corner).abs()[part] / 2 / direction.norm(dim=1) ** 3
        return points, points.density * angle / self.parts.chance.to(uv.device)[part]


def _of_mesh(light: MeshLight, first_face: int, seed: int) -> tuple[LightParts, Tensor]:
    mesh, chance = light.mesh, light.chance
    assert mesh.material is not None
    faces = (chance > 0).nonzero()[:, 0]
    if len(faces) > MOST_FACES:
        faces, _ = pick(chance.cumsum(0), _even(MOST_FACES, seed)[:, 0].to(chance))
        chance = torch.full_like(chance, 1 / MOST_FACES)
    corner = mesh.verts.detach()[mesh.faces[faces].long()].double().cpu()
    # In an order that keeps neighbours together, for the kernel tests edges against blocks of parts.
    order = z_order(corner.mean(1))
    faces = faces.cpu()[order]
    own = (faces + first_face).int()
    return LightParts(corner[order], chance.cpu()[faces], own, False, True, mesh.material.two_sided), faces


def triangles_of(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return triangles around the origin (L, 3, 3), and (L,) about the share of the unit directions (N, 3) through each.
    They are the faces of an octahedron, divided until no share is large."""
    triangles, chances = [], []
    most = len(directions) / LEAST_PARTS_OF_ENVIRONMENT
    octant = (directions < 0).long() @ torch.tensor([1, 2, 4])
    for k in range(8):
        signs = torch.tensor([1.0 - 2 * (k >> axis & 1) for axis in range(3)], dtype=torch.float64)
        through = directions[octant == k].abs()
        waiting = [(torch.diag(signs), through / through.sum(1, keepdim=True))]
        while waiting:
            corner, b = waiting.pop()
            if len(b) <= most or float((corner[1] - corner[0]).norm()) < 1e-4:
                triangles.append(corner)
                chances.append((len(b) + 1) / len(directions))
                continue
            middle = (corner + corner.roll(-1, 0)) / 2
            some = b.amax(1) < 0.5
            waiting.append((middle, 1 - 2 * b[some].roll(1, 1)))
            for i in range(3):
                some = b[:, i] >= 0.5
                less = 2 * b[some]
                less[:, i] -= 1
                waiting.append(((corner + corner[i]) / 2, less))
    return torch.stack(triangles), torch.tensor(chances, dtype=torch.float64)


def z_order(place: Tensor) -> Tensor:
    """Return the order (K,) int64 of places (K, 3) along a Z-curve through the cube around them (Morton 1966)."""
    low, high = place.amin(0), place.amax(0)
    size = (high - low).amax()
    cell = ((place - low) / torch.where(size > 0, size, 1.0) * 1023.99).long()
    code = torch.zeros(len(place), dtype=torch.int64, device=place.device)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort()


def _even(count: int, seed: int) -> Tensor:
    """Return numbers (count, 3) float64 in [0, 1), with a random shift: the first column ascends in equal steps, the others
    fill the unit square evenly (Roberts 2018)."""
    shift = [(mixed_bits(mixed_bits(seed) + k) >> 11) * 2.0**-53 for k in range(3)]
    rows = torch.arange(count)
    columns = [(rows.double() + shift[0]) / count]
    for k in (1, 2):
        bits = rows * STEPS[k] + signed(mixed_bits(seed * 3 + k))
        columns.append(((bits >> 11) & ((1 << 53) - 1)).double() * 2.0**-53)
    return torch.stack(columns, 1).clamp(max=1 - 2.0**-53)
