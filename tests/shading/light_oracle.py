"""Radiance of surfaces once more, for tests of how points of lights are drawn: rays find what shines.

    L(y, v) = emission + E[f(v, l) max(0, n·l) E(y, l) / p(l)]

Directions l are drawn all over the hemisphere by the cosine, by the density of the microfacets' normals, and in cones around
what shines, in equal shares, weighted by the balance heuristic; a ray finds what light there is. Surfaces, textures and f are
those of edgegrad, differentiable by PyTorch; no draw, density, weight or shadow ray is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from oracles.shading import emission_of
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.light.bsdf import dot, ggx, terminator
from edgegrad.light.shaded_points import ShadedPoints, of_each_mesh, on_mesh, where_seen

F64 = torch.float64
AWAY = 1e-6  # where rays begin, along themselves


class Ball(NamedTuple):
    """A ball around an emitter."""

    center: Tensor  # (3,)
    radius: float


def around(mesh: eg.Mesh) -> Ball:
    verts = mesh.verts.detach().double()
    center = (verts.amin(0) + verts.amax(0)) / 2
    return Ball(center, 1.01 * float((verts - center).norm(dim=1).max()))


class Oracle:
    """A shader of Hits. `balls` hold what is small and bright; what blends hides nothing, so its alpha must be below ½."""

    def __init__(self, balls: list[Ball], seed: int, draws: int = 4) -> None:
        self._balls, self._draws = balls, draws
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, hits: eg.points.Hits) -> Tensor:
        return of_each_mesh(hits, self._of_mesh)

    def _of_mesh(self, hits: eg.points.Hits, index: int) -> Tensor:
        scene, at = hits._surfaces.scene, on_mesh(hits, index)
        material = at.mesh.material
        assert material is not None
        surface = ShadedPoints.from_hits(hits, at, material)
        emission = emission_of(at, material)
        total = surface.g.new_zeros((len(hits), 1)) if emission is None else emission
        casters = scene.replace(
            meshes=[m for m in scene.meshes if m.material is None or m.material.alpha_mode != "BLEND"]
        )
        for light in scene.lights:
            if isinstance(light, eg.lights.PointLight):
                d = light.position - surface.position
                far = d.norm(dim=1, keepdim=True)
                there = _nearest(casters, surface.position, d / far) >= far.detach()[:, 0] * (1 - 1e-6)
                reaches = light.intensity * there[:, None] / far**2
                total = total + _scattered(surface, d / far) * reaches
        for _ in range(self._draws):
            l, density = self._draw(surface)
            total = total + _scattered(surface, l) * _seen(scene, casters, surface.position, l) / density / self._draws
        return where_seen(hits, material, total)

    @torch.no_grad()
    def _draw(self, surface: ShadedPoints) -> tuple[Tensor, Tensor]:
        """Unit directions (N, 3) and their densities (N, 1)."""
        n, v, y = (t.detach().double() for t in (surface.n, surface.v, surface.position))
        roughness = (
            n.new_ones((1, 1)) if surface.scattering.roughness is None else surface.scattering.roughness.detach()
        )
        alpha = (roughness.double() ** 2).clamp(min=1e-4).expand(len(n), 1)
        u = torch.rand((len(n), 3), dtype=F64, generator=self._generator)
        phi = 2 * math.pi * u[:, 1:2]
        cones = [_cone(ball, y) for ball in self._balls]
        share = 1 / (2 + len(cones))
        kind = (u[:, :1] / share).long().clamp(max=1 + len(cones))
        r = u[:, 2:]
        sine = r.sqrt()
        l = _around(n, sine * phi.cos(), sine * phi.sin(), (1 - r).sqrt())
        tan2 = alpha**2 * r / (1 - r)
        cosine = 1 / (1 + tan2).sqrt()
        sine = (1 - cosine**2).clamp(min=0).sqrt()
        h = _around(n, sine * phi.cos(), sine * phi.sin(), cosine)
        l = torch.where(kind == 1, 2 * dot(v, h) * h - v, l)
        for k, (axis, least) in enumerate(cones):
            cosine = 1 - r * (1 - least)
            sine = (1 - cosine**2).clamp(min=0).sqrt()
            l = torch.where(kind == 2 + k, _around(axis, sine * phi.cos(), sine * phi.sin(), cosine), l)
        h = normalize(v + l, dim=1)
        density = dot(n, l).clamp(min=0) / math.pi
        density = density + ggx(n, h, alpha**2) * dot(n, h).clamp(min=0) / (4 * dot(v, h).clamp(min=1e-12))
        for axis, least in cones:
            density = density + torch.where(dot(axis, l) >= least, 1 / (2 * math.pi * (1 - least)), 0.0)
        return l, torch.where(density > 0, share * density, math.inf)


def _cone(ball: Ball, y: Tensor) -> tuple[Tensor, Tensor]:
    """Axes (N, 3) and cosines (N, 1) of the cones that hold a ball; all directions within it."""
    d = ball.center - y
    far = d.norm(dim=1, keepdim=True)
    sine = ball.radius / far
    return d / far, torch.where(sine < 1, (1 - sine**2).clamp(min=0).sqrt(), -1.0)


def _around(axis: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    other = torch.where(axis[:, :1].abs() < 0.7, axis.new_tensor([1.0, 0, 0]), axis.new_tensor([0.0, 1, 0]))
    across = normalize(torch.linalg.cross(axis, other), dim=1)
    return x * across + y * torch.linalg.cross(axis, across) + z * axis


def _scattered(surface: ShadedPoints, l: Tensor) -> Tensor:
    """(N, C): f max(0, n·l), zero below the face."""
    above = (dot(surface.n, l) > 0) & (dot(surface.g, l) > 0)
    l = torch.where(above, l, surface.n.detach())
    value = surface.scattering.evaluate(surface.v, surface.n, l) * dot(surface.n, l)
    if not surface.flat:
        value = value * terminator(surface.g, surface.n, l)
    return torch.where(above, value, 0.0)


def _nearest(casters: eg.Scene, place: Tensor, l: Tensor) -> Tensor:
    """(N,) how far rays go."""
    with torch.no_grad():
        l = l.detach().double()
        hits = eg.points.trace(casters, place.detach().double() + AWAY * l, l)
        return torch.full((len(l),), math.inf, dtype=F64).index_copy(0, hits.ray, hits.depth.double())


def _seen(scene: eg.Scene, casters: eg.Scene, place: Tensor, l: Tensor) -> Tensor:
    """(N, C) what shines at the ends of rays: differentiable by radiance alone."""
    hits = eg.points.trace(casters, place.detach().double() + AWAY * l, l)
    found = torch.zeros((len(l), scene.channels), dtype=F64)
    free = torch.ones(len(l), dtype=torch.bool).index_fill(0, hits.ray, False)
    for light in scene.lights:
        if isinstance(light, eg.lights.Environment):
            found = found + torch.where(free[:, None], light.towards(l), 0.0)

    def emitted(own: eg.points.Hits, index: int) -> Tensor:
        at = on_mesh(own, index)
        material = at.mesh.material
        emission = None if material is None else emission_of(at, material)
        if material is None or emission is None:
            return torch.zeros((len(own), 1), dtype=F64)
        return where_seen(own, material, emission.expand(len(own), -1))

    return found.index_add(0, hits.ray, of_each_mesh(hits, emitted).to(found))
