"""Surfaces that one sees through (glTF's alpha mode BLEND): rays go on behind them, surface after surface."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..scene.appearance import OnMesh
from ..scene.textures import look_up
from .hits import Hits
from .image_context import ImageContext
from .records import CurveRecords, trace
from .surfaces import Surfaces

MOST_LAYERS = 8  # surfaces along a ray; what lies behind the last is left out


class Blended:
    """A shader that composes what is seen along a ray: α L + (1 − α) L_behind (Porter and Duff 1984, "over")."""

    def __init__(self, context: ImageContext, shader: Callable[[Hits], Tensor], background: Tensor | None) -> None:
        self._context, self._shader, self._background = context, shader, background

    def __call__(self, hits: Hits) -> Tensor:
        return self._from(hits, MOST_LAYERS)

    def _from(self, hits: Hits, left: int) -> Tensor:
        radiance = self._shader(hits)
        alpha = opacity(hits).to(radiance.dtype)
        with torch.no_grad():
            through = (alpha < 1)[:, 0].nonzero()[:, 0]
        if left == 1 or len(through) == 0:
            return radiance
        behind = self._behind(hits._subset(through), radiance.shape[1], left).to(radiance.dtype)
        return (alpha * radiance).index_add(0, through, (1 - alpha[through]) * behind)

    def _behind(self, hits: Hits, channels: int, left: int) -> Tensor:
        """Return the radiance (N, C) of what rays meet behind hits."""
        context = self._context
        with torch.no_grad():
            found = trace(hits._surfaces.geometry, hits.position.double(), -hits.view.double(), hits._face)
            face = context.here(found.face)
            meets = (face >= 0).nonzero()[:, 0]
            x, seed = hits.pixel.double().cpu(), hits._seed[meets]
        total = self._behind_all(x, channels)
        if len(meets) == 0:
            return total
        x = x[meets.cpu()]
        if hits._surfaces is context.surfaces:
            next_ = context.moving_hits(face[meets], context.rays_at(x), x, seed)
        else:
            next_ = context.fixed_hits(face[meets], context.here(found.b)[meets], x, seed)
        radiance = self._from(next_, left - 1)
        return total.to(radiance.dtype).index_copy(0, meets, radiance)

    def _behind_all(self, x: Tensor, channels: int) -> Tensor:
        """Return the background (N, C) at places (N, 2)."""
        context, background = self._context, self._background
        if background is None:
            return context.fixed.verts.new_zeros((len(x), channels))
        if background.dim() == 1:
            return background.expand(len(x), -1)
        column, row = (x[:, k].floor().long().clamp(0, n - 1) for k, n in enumerate((context.width, context.height)))
        return background[context.here(row), context.here(column)]


def transparent(surfaces: Surfaces) -> Tensor:
    """Return which faces are alpha-blended (F,) bool."""
    blends = torch.tensor([mesh.blends for mesh in surfaces.scene.meshes], device=surfaces.mesh_of_face.device)
    return blends[surfaces.mesh_of_face]


def let_through(context: ImageContext, records: CurveRecords) -> Tensor:
    """Return the share Π (1 − α) that surfaces before samples on curves let through (S,) float64, without derivatives."""
    sample = context.here(records.transparent_row_of)
    passed = context.fixed_hits(records.transparent, records.transparent_b, records.x[records.transparent_row_of])
    total = torch.ones(len(records.x), dtype=torch.float64, device=context.device)
    return total.scatter_reduce(0, sample, 1 - opacity(passed)[:, 0].double(), "prod")


def opacity(hits: Hits) -> Tensor:
    """Return the alpha (N, 1) of meshes that blend, at most 1; 1 elsewhere."""
    surfaces = hits._surfaces
    alpha = surfaces.verts.new_ones((len(hits), 1))
    for index, mesh in enumerate(surfaces.scene.meshes):
        if not mesh.blends:
            continue
        assert mesh.alpha is not None and mesh.uvs is not None and mesh.uv_faces is not None
        rows = (surfaces.mesh_of_face[hits._face] == index).nonzero()[:, 0]
        at = OnMesh(mesh, hits._face[rows] - surfaces.first_faces[index], hits._barycentrics[rows])
        uv = at.interpolated(mesh.uvs, mesh.uv_faces)
        found = look_up(mesh.alpha.to(surfaces.verts.device)[..., None], uv, mesh.wraps, mesh.filter)
        alpha = alpha.index_copy(0, rows, found.to(alpha).clamp(0, 1))
    return alpha
