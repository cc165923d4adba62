"""Points of lights for shaders, drawn as those of render() are: by what the materials of surfaces make of them."""

from __future__ import annotations

import torch
from torch import Tensor

from ..points.hits import Hits
from ..points.surfaces import View
from ..scene.environment import Environment
from ..scene.lights import Light, LightPoints
from . import in_kernel
from .radiance import _on_mesh, _points_of, _Surface


@torch.no_grad()
def points_by_material(hits: Hits, light: Light, samples: int) -> list[LightPoints]:
    """`samples` points of a light for each of the hits; those of lights whose shadow's border is sampled are given."""
    if light.punctual or hits._knows_light(light):
        return [hits.light_points(light, k, samples) for k in range(samples)]
    if isinstance(hits._view, View) and in_kernel.is_fused(hits._surfaces.scene):
        return in_kernel.light_points(hits, light, samples)
    return reference(hits, light, samples)


@torch.no_grad()
def reference(hits: Hits, light: Light, samples: int) -> list[LightPoints]:
    """The same in PyTorch."""
    surfaces = hits._surfaces
    index = torch.zeros((samples, len(hits)), dtype=torch.int64, device=hits._face.device)
    uv, density = hits._exact.new_zeros((samples, len(hits), 2)), hits._exact.new_ones((samples, len(hits)))
    for number, mesh in enumerate(surfaces.scene.meshes):
        rows = (surfaces.mesh_of_face[hits._face] == number).nonzero()[:, 0]
        own = hits._subset(rows)  # with steps of its own: none is declared
        for k, points in enumerate(_of_mesh(own, number, mesh.material is None, light, samples)):
            index[k, rows], uv[k, rows], density[k, rows] = points
    return [LightPoints(index[k], uv[k], density[k]) for k in range(samples)]


def _of_mesh(hits: Hits, number: int, bare: bool, light: Light, samples: int) -> list[LightPoints]:
    at = _on_mesh(hits, number)
    if not bare:
        assert at.mesh.material is not None
        return list(_points_of(hits, light, samples, _Surface.of(hits, at, at.mesh.material)))
    drawn = [hits.light_points(light, k, samples) for k in range(samples)]
    if not isinstance(light, Environment):
        return drawn
    g = hits._surfaces.face_normals(hits._face)
    side: Tensor = torch.where((g * hits.view).sum(1, keepdim=True) >= 0, 1.0, -1.0).to(g)
    return [light.above(points, side * g) for points in drawn]
