"""Meshes that emit as surfaces meet them: which of their faces lie in a direction, and what hides them
(csrc/shading/lit/mesh_light_sampling.h, mesh_light_sampling.h)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgegrad.light.bsdf import dot
from edgegrad.light.sampling import hides, least_brightness, tree_of
from edgegrad.points.records import values_of
from edgegrad.points.shadow_rays import LEAST_ROUNDING
from edgegrad.scene.lights import LightPoints
from edgegrad.scene.mesh_light import MeshLight
from edgegrad.scene.rows import unit

from .lobes import Lobes, axes_around

LEAST_EMITTER = 0.25  # solid angle over that of a lobe, below which nothing is drawn by the lobe
LEAST_ROUND = 1.0  # the same of round lights
FARTHEST_LOBE = 4.0  # between them, in half angles of the lobe
SMALLEST_EMITTER = 0.1  # solid angle over that of a lobe, below which points of a flat light are interchangeable


class EmissiveMeshSampler(NamedTuple):
    """A light as N points of surfaces meet it, without derivatives, in float64."""

    light: MeshLight
    position: Tensor  # (N, 3)
    own: Tensor  # (N,) the points' faces, as the light's mesh counts its own
    contact: Tensor  # (N,) distance within which nothing hides it

    @classmethod
    def of(cls, light: MeshLight, position: Tensor, own: Tensor) -> EmissiveMeshSampler:
        size = position.abs().amax(1).clamp(min=tree_of(light).ball[4])
        spacing = max(torch.finfo(light.mesh.verts.dtype).eps, LEAST_ROUNDING)
        return cls(light, position, own, 32 * spacing * size)

    def select(self, rows: Tensor) -> EmissiveMeshSampler:
        return EmissiveMeshSampler(self.light, *(part[rows] for part in self[1:]))

    def repeated(self, times: int) -> EmissiveMeshSampler:
        return EmissiveMeshSampler(self.light, *(part.repeat_interleave(times, 0) for part in self[1:]))

    def _ball(self) -> tuple[Tensor, Tensor]:
        """(N, 1) the sine of half the angle of a ball around the light, 1 inside of it; (N, 3) the direction to its middle."""
        *center, radius, _ = tree_of(self.light).ball
        to = self.position.new_tensor(center) - self.position
        distance = to.norm(dim=1, keepdim=True)
        outside = distance > radius
        return torch.where(outside, radius / distance, 1.0), torch.where(outside, to / distance, 0.0)

    def _solid_angle(self, sine: Tensor) -> Tensor:
        return torch.where(sine < 1, 2 * math.pi * _one_minus_cosine(sine), 4 * math.pi)

    def _is_round(self) -> Tensor:
        """(N, 1) bool: whether it is round, and seen from outside."""
        density = np.ascontiguousarray(values_of(self.light.density)[0])
        return (self._ball()[0] < 1) & tree_of(self.light).is_round(density)

    def is_drawn_by_ball(self, lobes: Lobes) -> Tensor:
        """(N,) bool: whether what the light draws are directions to a ball around it."""
        return self._is_round()[:, 0] & ~self.is_drawn_by(lobes)

    def draw_by_ball(self, u: Tensor) -> Tensor:
        """(N, 3) unit directions that fill the cone around the ball evenly, from numbers (N, 2) in [0, 1)."""
        sine, middle = self._ball()
        z, phi = u[:, 1] * _one_minus_cosine(sine)[:, 0], 2 * math.pi * u[:, 0]
        across = (z * (2 - z)).sqrt()
        l = torch.stack([across * phi.cos(), across * phi.sin(), 1 - z], 1)
        return (l[:, None] @ axes_around(middle))[:, 0]

    def with_ball_density(self, points: LightPoints) -> LightPoints:
        """Points that were drawn whatever by, with the density of draw_by_ball()."""
        sine, _ = self._ball()
        return points._replace(density=self.solid_angles(points) / self._solid_angle(sine)[:, 0])

    def interchangeable(self, lobes: Lobes) -> Tensor:
        """(N,) bool: whether points that the light draws are interchangeable."""
        sine, _ = self._ball()
        small = (self._solid_angle(sine) < SMALLEST_EMITTER * lobes.solid_angle())[:, 0] & tree_of(self.light).is_flat
        return small | self.is_drawn_by_ball(lobes)

    def is_drawn_by(self, lobes: Lobes) -> Tensor:
        """(N,) bool: whether directions are drawn by lobes as well."""
        sine, middle = self._ball()
        wide = lobes.solid_angle()
        half = torch.acos(1 - wide / (2 * math.pi))
        near = torch.acos(dot(lobes.mirrored(), middle).clamp(-1, 1)) < torch.asin(sine) + FARTHEST_LOBE * half
        least = torch.where(self._is_round(), LEAST_ROUND, LEAST_EMITTER)
        some = (self._solid_angle(sine) >= least * wide) & ((sine >= 1) | near)
        return some[:, 0] & lobes.narrow

    def directions(self, place: Tensor) -> Tensor:
        """(N, 3) unit directions to places on the light."""
        return unit(place.detach() - self.position)

    def solid_angles(self, points: LightPoints) -> Tensor:
        """(N,): |dl/dq| of points, zero where the light hides them or shows nothing."""
        weights = self.light._weights(points)
        found = self.light.facing(points.index, weights, self.position)[:, 0]
        away = self.position - self.light.place(points).detach()
        behind = dot(self.light._area(points.index).double(), away)[:, 0] < 0
        hidden = behind & self._hidden_from_behind(points, away, behind)
        return torch.where(hidden | (points.index == self.own), 0.0, found.detach())

    def _hidden_from_behind(self, points: LightPoints, away: Tensor, asked: Tensor) -> Tensor:
        tree = tree_of(self.light)
        if not hides(self.light) or tree.is_flat:
            return torch.zeros_like(asked)
        if tree.is_convex:
            outside = (self._ball()[0] < 1)[:, 0]
            if bool(outside.all()):
                return outside
        else:
            outside = torch.zeros_like(asked)
        rows = (asked & ~outside).nonzero()[:, 0]
        far = away[rows].norm(dim=1)
        l = -away[rows] / far[:, None]
        ray, face, _, _ = self.select(rows)._crossings(l, far - self.contact[rows])
        others = (face != points.index[rows][ray]) & (face != self.own[rows][ray])
        return outside.index_fill(0, rows[ray[others]], True)

    def _crossings(self, l: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Ray, face, uv and distance of what lies in directions l (N, 3)."""
        arrays = values_of(self.position, l, self.contact, end)
        which, where = (torch.from_numpy(x).to(l.device) for x in tree_of(self.light).crossings(*arrays))
        return which[:, 0], which[:, 1], where[:, :2], where[:, 2]

    def towards(self, l: Tensor) -> tuple[Tensor, LightPoints]:
        """Return what lies in directions l (N, 3), nearest first: (M,) ascending rows, and points."""
        ray, face, uv, t = self._crossings(l, torch.full_like(self.contact, math.inf))
        kept = face != self.own[ray]
        ray, face, uv, t = ray[kept], face[kept], uv[kept], t[kept]
        if hides(self.light):
            nearest = torch.full_like(self.contact, math.inf).scatter_reduce(0, ray, t, "amin")
            kept = t <= (nearest + self.contact)[ray]
            ray, face, uv, t = ray[kept], face[kept], uv[kept], t[kept]
        order = torch.from_numpy(np.lexsort(values_of(face, t, ray))).to(ray.device)
        ray, face, uv = ray[order], face[order], uv[order]
        return ray, LightPoints(face, uv, self.light.density[face])

    def brightness(self, points: LightPoints) -> Tensor:
        """(N,): about how bright points are, but nowhere zero."""
        emission = self.light._emission(points.index, self.light._weights(points).to(self.light.mesh.verts))
        return emission.detach().double().abs().mean(1) + least_brightness(self.light)


def _one_minus_cosine(sine: Tensor) -> Tensor:
    return sine * sine / (1 + (1 - sine * sine).sqrt())
