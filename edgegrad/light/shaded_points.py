"""Points of surfaces with their materials, and light that they scatter, in PyTorch: for derivatives by texel edges of emitters
(emitter_texels.py), and for where textures are read (radiance.py: declare_texel_edges). The kernel shades all else."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..points.hits import Hits
from ..scene.appearance import OnMesh
from ..scene.lights import Light, LightPoints
from ..scene.material import Material
from .bsdf import Scattering, dot, terminator


class ShadedPoints(NamedTuple):
    """N points of surfaces with one material."""

    position: Tensor  # (N, 3)
    v: Tensor  # (N, 3) unit directions to the viewer
    g: Tensor  # (N, 3) unit normals of the faces, on the viewer's side
    n: Tensor  # (N, 3) unit shading normals
    scattering: Scattering
    flat: bool  # whether n is g

    @classmethod
    def from_hits(cls, hits: Hits, at: OnMesh, material: Material) -> ShadedPoints:
        base = at.base_color()
        g, v = hits._surfaces.face_normals(hits._face), hits.view
        side = torch.where(_in_front(g, v), 1.0, -1.0).to(g)
        n = at.shading_normal(g)
        lambertian = not material.is_glossy
        metallic, roughness = (
            None if lambertian else g.new_full((1, 1), default) if given is None else at.value(given)
            for given, default in ((material.metallic, 0.0), (material.roughness, 1.0))
        )
        flat = at.mesh.normals is None and material.normal_map is None
        return cls(hits.position, v, side * g, side * n, Scattering(base, metallic, roughness), flat)

    def select(self, rows: Tensor) -> ShadedPoints:
        position, v, g, n = (part[rows] for part in (self.position, self.v, self.g, self.n))
        return ShadedPoints(position, v, g, n, self.scattering.select(rows), self.flat)


def _in_front(g: Tensor, v: Tensor) -> Tensor:
    """Return whether points are seen from the front of their faces (N, 1)."""
    return dot(g.detach(), v.detach()) >= 0


def of_each_mesh(hits: Hits, of_mesh: Callable[[Hits, int], Tensor]) -> Tensor:
    """Return rows (N, C), of which of_mesh(hits, number) gives those of the points of each mesh."""
    surfaces = hits._surfaces
    meshes, C = surfaces.scene.meshes, surfaces.scene.channels
    if len(meshes) == 1:
        return of_mesh(hits, 0).expand(len(hits), C)
    total = hits._barycentrics.new_zeros((len(hits), C))
    for index in range(len(meshes)):
        rows = (surfaces.mesh_of_face[hits._face] == index).nonzero()[:, 0]
        total = total.index_copy(0, rows, of_mesh(hits.select(rows), index).expand(len(rows), C))
    return total


def on_mesh(hits: Hits, index: int) -> OnMesh:
    """Return where hits lie on the mesh with this number."""
    surfaces = hits._surfaces
    return OnMesh(
        surfaces.scene.meshes[index],
        hits._face - surfaces.first_faces[index],
        hits._barycentrics,
        hits._look_up,
        lambda: surfaces.tangents(index),  # pyright: ignore[reportArgumentType]: asked for where there are some
    )


def where_seen(hits: Hits, material: Material, total: Tensor) -> Tensor:
    """Return the radiance `total` (N, C), black at backs of materials that are not two-sided."""
    front = _in_front(hits._surfaces.face_normals(hits._face), hits.view)
    return total if material.two_sided else torch.where(front, total, 0.0)


def scattered(
    hits: Hits,
    light: Light,
    points: LightPoints,
    surface: ShadedPoints,
    shadows: bool,
    arriving: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """Return f max(0, n·l) V E (N, C), with E by arriving(rows, positions)."""
    with torch.no_grad():
        l = light.incident(points, surface.position)
        facing = ((dot(surface.n, l) > 0) & (dot(surface.g, l) > 0))[:, 0]
        facing &= light.shows(points) & points.density.isfinite()
    rows = facing.nonzero()[:, 0]
    C = hits._surfaces.scene.channels
    total = surface.position.new_zeros((len(hits), C))
    if len(rows) == 0:
        return total
    surface, points = surface.select(rows), points.select(rows)
    l = light.incident(points, surface.position)
    arrived = arriving(rows, surface.position) * dot(surface.n, l)
    if not surface.flat:
        arrived = arrived * terminator(surface.g, surface.n, l)
    if shadows:
        arrived = arrived * hits._subset(rows).visible_from(light, points)[:, None]
    found = surface.scattering.evaluate(surface.v, surface.n, l) * arrived
    return total.index_copy(0, rows, found.expand(len(rows), C))
