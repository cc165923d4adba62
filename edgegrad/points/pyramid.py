"""A texture and its means over squares of 2, 4, 8 … texels (Williams 1983)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.first_order import Tensors, apply, array
from ..kernel.threads import threads
from ..library import core
from ..scene.textures import bilinear_of_rows


class Pyramid(NamedTuple):
    """A texture and the levels above it, each half as high and wide as the one before, rounded down."""

    texels: Tensor  # (M, K) of one level after the other, row by row
    first: Tensor  # (L,) int64, the first row of a level
    height: Tensor  # (L,) int64
    width: Tensor  # (L,) int64

    @classmethod
    def from_texture(cls, texture: Tensor) -> Pyramid:
        sizes = [texture.shape[:2]]
        while max(sizes[-1]) > 1:
            sizes.append(torch.Size(max(1, n // 2) for n in sizes[-1]))
        height, width = torch.tensor(sizes, device=texture.device).unbind(1)
        count = height * width
        known = texture if texture.dtype in (torch.float32, torch.float64) else texture.double()
        (texels,) = apply(_Means(*texture.shape[:2]), [known.cpu()])
        return cls(texels.to(texture), count.cumsum(0) - count, height, width)

    def look_up(self, level: Tensor, uv: Tensor, wraps: tuple[str, ...]) -> Tensor:
        """Return values (N, K) at uv (N, 2), linear between the two levels around `level` (N,)."""
        level = level.clamp(0, len(self.first) - 1)
        below = level.detach().floor().long()
        share = (level - below).to(self.texels.dtype)[:, None]
        fine, coarse = (
            bilinear_of_rows(self.texels, self.first[at], self.height[at], self.width[at], uv, wraps)
            for at in (below, (below + 1).clamp(max=len(self.first) - 1))
        )
        return (1 - share) * fine + share * coarse


class _Means(NamedTuple):
    """csrc/texture/pyramid.h"""

    height: int
    width: int

    @property
    def moving(self) -> Sequence[int]:
        return (0,)

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        (image,) = map(array, tensors)  # pyright: ignore[reportArgumentType]
        return (torch.from_numpy(core.pyramid(image, threads())),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        return [torch.from_numpy(core.pyramid_vjp(array(bar), self.height, self.width, threads()))]

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        return self.value(tangents)[0]
