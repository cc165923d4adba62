"""Distances on surfaces from pixel to pixel, and the levels of a texture's pyramid that these ask for (Williams 1983)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.derivatives import moves
from .pyramid import Pyramid
from .records import RayRecords
from .surfaces import CameraView, Surfaces


class Footprints(NamedTuple):
    """The footprints of pixels at N points of surfaces."""

    surfaces: Surfaces
    view: CameraView
    face: Tensor  # (N,)
    pixel: Tensor  # (N, 2)
    rays_at: Callable[[Tensor], RayRecords]

    def spread(self) -> Tensor:
        """Return the change of the last two barycentrics one pixel to the right, and one down: (N, 2, 2) float64."""
        rays_at, pixel = self.rays_at, self.pixel
        aside = 1 / 64  # px, so small that texture coordinates are nearly affine in the image
        rays = rays_at(pixel)
        if moves(rays.along):
            # As functions of the intrinsics. Where a lens shows nothing, the ray of the pixel itself stands for its neighbour.
            offsets = pixel.new_tensor([[aside, 0], [-aside, 0], [0, aside], [0, -aside]])
            found = rays_at((pixel[:, None] + offsets).flatten(0, 1)).along.unflatten(0, (-1, 4))
            along = torch.where(torch.isfinite(found), found, rays.along[:, None])
        else:
            by_x = aside * rays.along_by_x.mT
            along = rays.along[:, None] + torch.stack([by_x, -by_x], 2).flatten(1, 2)
        b = self.view.barycentrics(self.surfaces, self.face, along.flatten(0, 1)).unflatten(0, (-1, 2, 2))
        return (b[:, :, 0, 1:] - b[:, :, 1, 1:]) / (2 * aside)


def level(texture: Tensor, corner_uvs: Tensor, spread: Tensor) -> Tensor:
    """Return (N,) log2 of the distance in texels of neighbouring pixels, the larger of both directions. `corner_uvs` (N, 3, 2)
    are the texture coordinates of the faces' corners. csrc/shading/lit/source.h has the same."""
    corners = corner_uvs.double()
    edges = (corners[:, 1:] - corners[:, :1]) * corners.new_tensor([texture.shape[1], texture.shape[0]])
    texels = spread[:, :, :1] * edges[:, None, 0] + spread[:, :, 1:] * edges[:, None, 1]
    right, down = (texels * texels).sum(2).unbind(1)
    most = torch.nan_to_num(torch.maximum(right, down), nan=1.0, posinf=1e18).clamp(1, 1e18)
    return 0.5 * most.log2()


def pyramid_of(surfaces: Surfaces, texture: Tensor) -> Pyramid:
    """Return the pyramid of a texture, kept with the surfaces where they have no graph."""
    if torch.is_grad_enabled():
        return Pyramid.from_texture(texture)
    if id(texture) not in surfaces.pyramids:
        surfaces.pyramids[id(texture)] = texture, Pyramid.from_texture(texture)
    return surfaces.pyramids[id(texture)][1]
