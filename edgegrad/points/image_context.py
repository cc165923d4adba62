"""One image of a scene: the surfaces, view and seeds that its samples share, and their sums in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..kernel.request import Request
from ..sampling import camera_seed
from ..scene.scene import Scene
from .discontinuities import Discontinuities
from .hits import Hits
from .records import RayRecords, SurfaceRecords, barycentrics, with_attributes
from .sampler import Sampler
from .seeds import sample_seeds
from .shadow_rays import Forced
from .sobol import z_order
from .splat import SplatTerm, attached
from .surfaces import CameraView, Surfaces

_Rays = TypeVar("_Rays", bound=RayRecords | SurfaceRecords)
# Each kind has its own random numbers.
SEED_KINDS = (
    "image", "inside", "edges", "discontinuities", "shadows", "image again", "indirect shadows", "secondary edges",
    "surface edges",
)  # fmt: skip


class ImageContext:
    """One image of a scene."""

    def __init__(self, scene: Scene, request: Request, index: int = 0) -> None:
        packed = request.camera
        self.request, self._index = request._replace(scene=with_attributes(request.scene)), index
        self.surfaces = Surfaces(scene, self.request.scene)
        self.device, self.dtype = self.surfaces.verts.device, self.surfaces.verts.dtype
        self.sampler = Sampler(self.request, index, torch.finfo(self.dtype).eps ** (2 / 3))
        self.view = CameraView(packed.world_to_camera[index].to(self.device, torch.float64), packed.perspective)
        self.fixed, self.fixed_view = self.surfaces.detach(), self.view.detach()
        self.intrinsics = torch.cat([packed.K[index, :2].reshape(6), packed.distortion[index]])
        self.height, self.width = packed.height, packed.width

    @property
    def pixels(self) -> int:
        return self.height * self.width

    def here(self, tensor: Tensor) -> Tensor:
        """Return a tensor on the device of the scene."""
        return tensor.to(self.device)

    def seeds(self, kind: str, count: int, first: int = 0) -> Tensor:
        """Return the seeds (count,) int64 of the samples of a kind from `first` on."""
        request = self.request
        seed = camera_seed(int(request.image.seed), self._index) if kind.startswith("image") else self.sampler.grad_seed
        return self.here(sample_seeds(seed, SEED_KINDS.index(kind), first, count))

    def seeds_of_pixels(self, kind: str, pixel: Tensor, each: int) -> Tensor:
        """Return the seeds (N,) int64 of hits in the pixels (N,) in ascending order, about `each` in one. Those of a pixel do
        not depend on what other pixels see, so a small motion changes the image by little."""
        row = torch.arange(len(pixel))
        begins = torch.ones(len(pixel), dtype=torch.bool)
        begins[1:] = pixel[1:] != pixel[:-1]
        among = row - torch.where(begins, row, 0).cummax(0).values if len(pixel) else row
        place = z_order(pixel.long() % self.width, pixel.long() // self.width)
        return self.seeds(kind, 1) + self.here(each * place + among)

    def fixed_hits(
        self,
        face: Tensor,
        b: Tensor,
        x: Tensor,
        seed: Tensor | None = None,
        discontinuities: Discontinuities | None = None,
        forced: Forced | None = None,
    ) -> Hits:
        """Return hits without derivatives; b are (N, 3), or the last two barycentrics."""
        place = self.here(face), self.here(b if b.shape[1] == 3 else barycentrics(b)), self.here(x)
        return Hits(self.fixed, self.fixed_view, *place, self._fixed_rays_at, discontinuities, seed, forced)

    @property
    def no_hits(self) -> Hits:
        """Return hits without points, for which a shader still notes where it may jump."""
        none = torch.zeros(0, dtype=torch.int64)
        return self.fixed_hits(
            none, torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.float64), none
        )

    def moving_hits(
        self, face: Tensor, rays: RayRecords | SurfaceRecords, x: Tensor, seed: Tensor | None = None
    ) -> Hits:
        """Return hits as differentiable functions of vertices and camera, at fixed places in the image."""
        face = self.here(face)
        b = self.view.barycentrics(self.surfaces, face, self.here(self._moving(rays).along))
        return Hits(self.surfaces, self.view, face, b, self.here(x), lambda x: self._moving(self.rays_at(x)), seed=seed)

    def rays_at(self, x: Tensor) -> RayRecords:
        """Return the rays to places (N, 2), for moving_hits()."""
        return self.sampler.rays_at(x, moves(self.intrinsics))

    def _fixed_rays_at(self, x: Tensor) -> RayRecords:
        return self.sampler.rays_at(x, intrinsics=False)

    def _moving(self, rays: _Rays) -> _Rays:
        """Return the rays as functions of the intrinsics, at fixed places in the image."""
        if not moves(self.intrinsics):
            return rays
        moved = rays.along_by_k @ (self.intrinsics - self.intrinsics.detach()).to(rays.along_by_k.device)
        return rays._replace(along=rays.along + moved)

    def image(self, pixel: Tensor, values: Tensor, pixels: range | None = None) -> Tensor:
        """Return the sum of the values (N, C) in each pixel, or in each of a range: (H · W, C)."""
        pixels = pixels or range(self.pixels)
        return values.new_zeros((len(pixels), values.shape[1])).index_add(0, self.here(pixel) - pixels.start, values)

    def attached(self, image: Tensor, terms: Sequence[SplatTerm]) -> Tensor:
        """Return the image with the derivatives of the terms: see attached()."""
        return attached(image.reshape(self.pixels, -1), terms, self.request).reshape(image.shape)

    def composed(self, image: Tensor, background: Tensor | None) -> Tensor:
        """Return the image (H, W, C) before a background (C,) or (H, W, C)."""
        image = image.reshape(self.height, self.width, -1)
        if background is None:
            return image
        coverage = self.here(self.sampler.coverage).to(image.dtype)
        return image + (1 - coverage)[:, :, None] * background.to(image)
