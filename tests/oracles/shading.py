"""Lit surfaces in PyTorch: what the kernel (csrc/shading/lit) computes for hits, at the same random points of lights."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edgegrad.light.creases import note_jumps
from edgegrad.light.emitter_texels import by_texel_edges, moving_emitters
from edgegrad.light.radiance import Lighting
from edgegrad.light.sampling import tree_of
from edgegrad.light.shaded_points import ShadedPoints, of_each_mesh, on_mesh, scattered, where_seen
from edgegrad.points.hits import Hits
from edgegrad.scene.appearance import OnMesh
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import Light, LightPoints, SphericalHarmonics
from edgegrad.scene.material import Material
from edgegrad.scene.mesh_light import MeshLight

from .mesh_light_sampling import EmissiveMeshSampler
from .resampled import Glossy, resampled


def radiance(hits: Hits, shadows: bool = True, lights_each: int = 1) -> Tensor:
    """Return what render() takes as the radiance (N, C) in direct light, also for hits of trace()."""
    note_jumps(hits, False)
    L, lights = reference(hits, shadows, lights_each), moving_emitters(hits)
    return L + by_texel_edges(hits, lights, shadows, lights_each) if lights else L


def reference(hits: Hits, shadows: bool = True, lights_each: int = 1) -> Tensor:
    """Return what in_kernel.radiance() returns: (N, C), without the derivative by texel edges of lights."""
    lighting = Lighting(shadows, lights_each)
    return of_each_mesh(hits, lambda own, index: _of_mesh(own, index, lighting))


def emission_of(at: OnMesh, material: Material) -> Tensor | None:
    return None if material.emission is None else at.value(material.emission)


def _of_mesh(hits: Hits, index: int, lighting: Lighting) -> Tensor:
    """(N, C) or (N, 1)."""
    scene, at = hits._surfaces.scene, on_mesh(hits, index)
    material = at.mesh.material
    if material is None:
        base = at.base_color()
        return torch.zeros_like(base) if hits._only_light else base
    surface = ShadedPoints.from_hits(hits, at, material)
    total = surface.g.new_zeros((len(hits), 1))
    emission = None if hits._only_light else emission_of(at, material)
    if emission is not None:
        total = total + emission
    for light in scene.lights:
        if isinstance(light, SphericalHarmonics) and not hits._only_light:
            total = total + surface.scattering.diffuse / math.pi * light.irradiance(surface.n)
    for light in scene.casting:
        if hits._only_light and not hits._knows_light(light):
            continue
        count = 1 if light.punctual or hits._only_light else lighting.samples
        drawn = _points_of(hits, light, count, surface)
        for points in drawn:
            total = total + _light_sample(hits, light, points, surface, lighting.shadows) / len(drawn)
    return where_seen(hits, material, total)


def _points_of(hits: Hits, light: Light, count: int, surface: ShadedPoints) -> list[LightPoints]:
    """`count` points of a light for each point of a surface; where only derivatives are wanted, sets of an environment for a
    glossy one."""
    lambertian = surface.scattering.roughness is None
    by_light = lambertian or (isinstance(light, MeshLight) and tree_of(light) is None)
    if hits._knows_light(light) or light.punctual or by_light:
        drawn = [hits.light_points(light, sample, count) for sample in range(count)]
        if lambertian and isinstance(light, Environment) and not hits._knows_light(light):
            return [light.above(points, surface.g) for points in drawn]
        return drawn
    glossy = Glossy.of(surface.v, surface.n, surface.g, surface.scattering, hits._seed)
    index = hits._index(light)
    if isinstance(light, MeshLight):
        first_faces, meshes = hits._surfaces.first_faces, hits._surfaces.scene.meshes
        first = next(first for first, mesh in zip(first_faces, meshes, strict=True) if mesh is light.mesh)
        return resampled(
            light,
            index,
            glossy,
            count,
            EmissiveMeshSampler.of(light, surface.position.detach().double(), hits._face - first),
        )
    if hits._needs_values:
        return resampled(light, index, glossy, count)
    return resampled(light, index, glossy, count, antithetic=True)


def _light_sample(hits: Hits, light: Light, points: LightPoints, surface: ShadedPoints, shadows: bool) -> Tensor:
    """(N, C): f max(0, n·l) V E of one point of a light."""
    return scattered(hits, light, points, surface, shadows, lambda rows, y: light.arriving(points.select(rows), y))


@torch.no_grad()
def points_by_material(hits: Hits, light: Light, samples: int) -> list[LightPoints]:
    """Return what in_kernel.light_points() returns."""
    surfaces = hits._surfaces
    index = torch.zeros((samples, len(hits)), dtype=torch.int64, device=hits._face.device)
    uv, density = hits._exact.new_zeros((samples, len(hits), 2)), hits._exact.new_ones((samples, len(hits)))
    for number, mesh in enumerate(surfaces.scene.meshes):
        rows = (surfaces.mesh_of_face[hits._face] == number).nonzero()[:, 0]
        own = hits._subset(rows)  # with steps of its own: none is declared
        for k, points in enumerate(_points_of_mesh(own, number, mesh.material is None, light, samples)):
            index[k, rows], uv[k, rows], density[k, rows] = points
    return [LightPoints(index[k], uv[k], density[k]) for k in range(samples)]


def _points_of_mesh(hits: Hits, number: int, bare: bool, light: Light, samples: int) -> list[LightPoints]:
    at = on_mesh(hits, number)
    if not bare:
        assert at.mesh.material is not None
        return list(_points_of(hits, light, samples, ShadedPoints.from_hits(hits, at, at.mesh.material)))
    drawn = [hits.light_points(light, k, samples) for k in range(samples)]
    if not isinstance(light, Environment):
        return drawn
    g = hits._surfaces.face_normals(hits._face)
    side: Tensor = torch.where((g * hits.view).sum(1, keepdim=True) >= 0, 1.0, -1.0).to(g)
    return [light.above(points, side * g) for points in drawn]
