"""The near-field term: how light that nearby surfaces scatter changes as the shading point moves on its face.

At a fixed place x of the image, vertices and camera move the barycentrics b of the shading point by δξ = (∂b/∂x)⁻¹ δb, px.
With the further points of its path held on their faces, the derivative of light by δξ grows as one over the distance to them, and
near corners of a room its variance is infinite. But along an axis of the image the mean of a derivative is a difference,

    ∫ ∂L/∂x_a dx_a = L(r) − L(l)

over the part l … r of a pixel's width in which one sees the face, and L(l) and L(r) by the same random numbers differ little:
their paths go on in the same directions. So a sample at any place between them has D_a δξ_a with D_a = (L(r) − L(l)) / (r − l).
That is exact where δξ is linear in a pixel and the filter a box; of wider filters the width is a quarter of a pixel.

From afar the derivative is the quieter one. So L is only what comes from within a radius (csrc/shading/lit/near_field.h).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..points.hits import Hits
from ..points.image_context import ImageContext
from ..points.records import barycentrics

RADIUS_PX = 8.0  # px
PLACES = 12  # along each side of the image
WIDTH_OF_FILTERS = {"box": 1.0}
WIDTH_OF_OTHER_FILTERS = 0.25  # px
SHARE_WITHIN_FACE = 1 - 2.0**-12  # how far on its way to the border of a face a sample stays on it
HALVINGS = 12  # with which the border of what hides a face is looked for
LEAST_WIDTH = 2.0**-10  # px, below which a difference is rounding


def radius(context: ImageContext) -> float:
    """Return the radius of the near field in world units: some pixels where most of what is seen lies. 0: nothing is seen."""
    height, width = context.height, context.width
    y, x = (((torch.arange(PLACES) + 0.5) / PLACES * size).double() for size in (height, width))
    places = torch.cartesian_prod(x, y)
    with torch.no_grad():
        found = context.sampler.hits_at(places)
        some = found.face >= 0
        if not bool(some.any()):
            return 0.0
        rays = context.sampler.rays_at(places[some], intrinsics=False)
        by_x = context.here(rays.along_by_x).norm(dim=1).amax(1)
        if context.view.perspective:
            face, b = context.here(found.face[some]), context.here(barycentrics(found.b[some]))
            position = (b[:, :, None] * context.fixed.corners(face)).sum(1)
            by_x = (
                by_x * (position.double() - context.fixed_view.eye).norm(dim=1) / context.here(rays.along).norm(dim=1)
            )
        near = RADIUS_PX * float(by_x.median())
    return near if math.isfinite(near) else 0.0


class NearField(NamedTuple):
    """Light from within the radius that comes to hits inside faces."""

    context: ImageContext
    hits: Hits
    light: Callable[[Hits], Tensor]  # (N, C)
    # Declares where light jumps within faces (points/discontinuities.py); None: nowhere.
    declare: Callable[[Hits], object] | None

    def term(self) -> Tensor:
        """Return zeros (N, C) with its derivatives by where the hits lie on their faces."""
        context, surfaces, face = self.context, self.context.surfaces, self.hits._face
        none = context.fixed.verts.new_zeros((len(face), surfaces.scene.channels))
        if moves(context.view.world_to_camera, context.intrinsics):
            return self._of_all() if len(face) else none
        # What is seen of a mesh that stays does not slide.
        moving = context.here(torch.tensor([moves(mesh.verts) for mesh in surfaces.scene.meshes]))
        rows = moving[surfaces.mesh_of_face[face]].nonzero()[:, 0]
        if not len(rows):
            return none
        return none.index_copy(0, rows, self._replace(hits=self.hits._subset(rows))._of_all())

    def _of_all(self) -> Tensor:
        context, b, face = self.context, self.hits._exact, self.hits._face
        with torch.no_grad():
            rays = context.sampler.rays_at(self._x, intrinsics=False)
            along, by_x = context.here(rays.along), context.here(rays.along_by_x)
            _, b_by_x = context.fixed_view.barycentrics_by(context.fixed, face, along, by_x)
            to_px = torch.linalg.inv_ex(b_by_x[:, 1:])[0]  # (N, 2, 2)
            to_px = torch.where(to_px.isfinite().all(-1).all(-1)[:, None, None], to_px, 0.0)  # edge-on it has no image
            slope = [self._slope(axis, along, by_x[:, :, axis], b_by_x[:, :, axis]) for axis in (0, 1)]
            L_by_b = (torch.stack(slope, -1).double() @ to_px).to(context.dtype)  # (N, C, 2)
        return (L_by_b * (b - b.detach())[:, None, 1:].to(context.dtype)).sum(-1)

    @property
    def _x(self) -> Tensor:
        assert self.hits._pixel is not None
        return self.hits._pixel.detach()

    def _slope(self, axis: int, along: Tensor, along_by: Tensor, b_by: Tensor) -> Tensor:
        """Return differences (N, C) along an axis of the image, by which rays and barycentrics change by these (N, 3) a px."""
        context, place = self.context, self._x[:, axis]
        width = WIDTH_OF_FILTERS.get(context.request.image.filter, WIDTH_OF_OTHER_FILTERS)
        cell = (place / width).floor() * width
        # Barycentrics times what is positive, affine in x without a lens: of pinholes by planes through the eye and a side.
        value, slope = self.hits._exact.detach(), b_by
        if context.view.perspective:
            q = context.fixed_view.in_camera(context.fixed.corners(self.hits._face))
            planes = torch.stack([torch.linalg.cross(q[:, (i + 1) % 3], q[:, (i + 2) % 3]) for i in range(3)], 1)
            value, slope = ((planes * by[:, None]).sum(-1) for by in (along, along_by))
            turned = torch.where(value.sum(1, keepdim=True) < 0, -1.0, 1.0)
            value, slope = turned * value, turned * slope
        ends = []
        for side, limit in ((-1.0, place - cell), (1.0, cell + width - place)):
            leaves = side * slope < 0
            border = torch.where(
                leaves, SHARE_WITHIN_FACE * value.clamp(min=0.0) / slope.abs().clamp(min=1e-300), torch.inf
            )
            ends.append(self._visible(axis, side * torch.minimum(border.amin(1), limit)))
        L = [self.light(self._there(axis, end)) for end in ends]
        return (L[1] - L[0]) / (ends[1] - ends[0]).clamp(min=LEAST_WIDTH)[:, None].to(L[0].dtype)

    def _visible(self, axis: int, end: Tensor) -> Tensor:
        """Return how far one may go towards an end, px along an axis, before something hides the face or light jumps (N,)."""
        rows = (~self._sees(axis, end)).nonzero()[:, 0]
        if not len(rows):
            return end
        some = self._replace(hits=self.hits._subset(rows))
        near, far = torch.zeros_like(end[rows]), end[rows]
        for _ in range(HALVINGS):
            middle = 0.5 * (near + far)
            seen = some._sees(axis, middle)
            near, far = torch.where(seen, middle, near), torch.where(seen, far, middle)
        return end.index_copy(0, rows, near)

    def _sees(self, axis: int, t: Tensor) -> Tensor:
        """Return whether one sees the same face t px further along an axis, between the same discontinuities: (N,) bool."""
        there = self._there(axis, t)
        assert there._pixel is not None
        seen = self.context.here(self.context.sampler.hits_at(there._pixel).face) == self.hits._face
        if self.declare is None:
            return seen
        here, there = self._steps_at(self._there(axis, torch.zeros_like(t))), self._steps_at(there)
        return seen & (here == there).all(1)

    def _steps_at(self, hits: Hits) -> Tensor:
        """Return between which discontinuities hits lie (N, K)."""
        assert self.declare is not None
        self.declare(hits)
        return torch.stack([values.floor().nan_to_num() for values in hits._discontinuities.values], 1)

    def _there(self, axis: int, t: Tensor) -> Hits:
        """Return the hits t px further along an axis of the image, on the same faces and with the same random numbers."""
        context, x = self.context, self._x.clone()
        x[:, axis] += t
        along = context.here(context.sampler.rays_at(x, intrinsics=False).along)
        b = context.fixed_view.barycentrics(context.fixed, self.hits._face, along).clamp(min=0.0)
        b = b / b.sum(1, keepdim=True).clamp(min=1e-300)
        return context.fixed_hits(self.hits._face, b, x, self.hits._seed)
