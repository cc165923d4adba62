"""Derivatives of what emissive meshes give to surfaces, by the edges of their nearest texels. Light samples have none for these:

f max(0, n·l) V cos θ / r² · [E_i − E_{i−1}] δp / |∇p|        (scene/texel_edges.py)
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.derivatives import differentiates, moves
from ..points.hits import Hits
from ..scene.lights import LightPoints
from ..scene.mesh_light import MeshLight
from ..scene.texel_edges import TexelEdges
from .shaded_points import ShadedPoints, of_each_mesh, on_mesh, scattered, where_seen


def moving_emitters(hits: Hits) -> list[MovingEmitter]:
    """Return the lights whose texel edges may move."""
    found: list[MovingEmitter] = []
    scene = hits._surfaces.scene
    if not differentiates() or hits._forced is not None or len(hits) == 0:
        return found
    for number, light in enumerate(scene.casting):
        if not isinstance(light, MeshLight) or not light.has_texel_edges or not moves(light.coordinates):
            continue
        stream = len(scene.casting) + number
        first, second = hits.random(2, stream)[0].tolist()
        edges = light.texel_edges((first, second))
        if edges is not None:
            found.append(MovingEmitter(light, edges, stream))
    return found


class MovingEmitter(NamedTuple):
    light: MeshLight
    edges: TexelEdges
    stream: int  # of random numbers


def by_texel_edges(hits: Hits, lights: list[MovingEmitter], shadows: bool, samples: int) -> Tensor:
    """Return zeros (N, C) with the derivative of the radiance by the texel edges of lights, from as many points of edges as of
    each light."""

    def of_mesh(own: Hits, index: int) -> Tensor:
        total = own._barycentrics.new_zeros((len(own), 1))
        at = on_mesh(own, index)
        material = at.mesh.material
        if material is None:
            return total
        with torch.no_grad():
            surface = ShadedPoints.from_hits(own, at, material)
        for light, edges, stream in lights:
            for sample in range(samples):
                drawn = edges.draw(own.random(2, stream, sample, samples))
                with torch.no_grad():
                    reaches = scattered(
                        own,
                        light,
                        LightPoints(drawn.face, drawn.b[:, 1:], torch.ones_like(drawn.b[:, 0])),
                        surface,
                        shadows,
                        lambda rows, y, drawn=drawn, light=light: (
                            light.facing(drawn.face[rows], drawn.b[rows], y) * drawn.weight[rows]
                        ).to(y),
                    )
                    reaches = where_seen(own, material, reaches / samples)
                total = total + reaches * edges.motion(drawn).to(reaches)
        return total

    # Of other hits, which keep nothing that is computed here, and declare no discontinuities.
    return of_each_mesh(hits._subset(slice(None)), of_mesh)
