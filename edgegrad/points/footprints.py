"""How many texels a pixel covers, and so which level of a texture's pyramid it sees (Williams 1983)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..scene.rows import interpolated
from ..scene.textures import Pyramid
from .records import RayRecords
from .surfaces import Surfaces, View


class Footprints(NamedTuple):
    """Of N points of surfaces that a camera sees."""

    surfaces: Surfaces
    view: View
    face: Tensor  # (N,)
    pixel: Tensor  # (N, 2)
    rays_at: Callable[[Tensor], RayRecords]

    def level(self, texture: Tensor, corner_uvs: Tensor) -> Tensor:
        """(N,) the level: log2 of the distance in texels of neighbouring pixels, the larger of both directions. `corner_uvs`
        (N, 3, 2) are the texture coordinates of the faces' corners."""
        rays_at, pixel, corners = self.rays_at, self.pixel, corner_uvs.double()
        size = torch.tensor([texture.shape[1], texture.shape[0]], dtype=torch.float64, device=corners.device)
        step = 1 / 64  # px, so small that texture coordinates are nearly affine in the image
        rays = rays_at(pixel)

        def beside(axis: int, aside: float) -> Tensor:
            if not moves(rays.along):
                return rays.along + aside * rays.along_by_x[:, :, axis]
            # As functions of the intrinsics. Where a lens shows nothing, the ray of the pixel itself stands for its neighbour.
            offset = torch.zeros(2, dtype=pixel.dtype, device=pixel.device)
            offset[axis] = aside
            along = rays_at(pixel + offset).along
            return torch.where(torch.isfinite(along), along, rays.along)

        def squared(axis: int) -> Tensor:
            """The squared distance in texels of neighbouring pixels along an axis."""
            b = [self.view.barycentrics(self.surfaces, self.face, beside(axis, aside)) for aside in (step, -step)]
            texels = interpolated(b[0] - b[1], corners) * size / (2 * step)
            return (texels * texels).sum(1)

        most = torch.nan_to_num(torch.maximum(squared(0), squared(1)), nan=1.0, posinf=1e18).clamp(1, 1e18)
        return 0.5 * most.log2()


def pyramid_of(surfaces: Surfaces, texture: Tensor) -> Pyramid:
    """That of a texture, kept with the surfaces where they have no graph."""
    if torch.is_grad_enabled():
        return Pyramid.of(texture)
    if id(texture) not in surfaces.pyramids:
        surfaces.pyramids[id(texture)] = texture, Pyramid.of(texture)
    return surfaces.pyramids[id(texture)][1]
