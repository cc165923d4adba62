"""Looking up images at texture coordinates."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .rows import rows_of


def wrapped(cell: Tensor, count: int, wrap: str) -> Tensor:
    """Texels as they are counted in the texture, int64."""
    i = cell.detach().long()
    if wrap == "repeat":
        return i % count
    if wrap == "clamp":
        return i.clamp(0, count - 1)
    i = i % (2 * count)
    return torch.minimum(i, 2 * count - 1 - i)


def bilinear(texture: Tensor, uv: Tensor, wraps: tuple[str, ...]) -> Tensor:
    h, w = texture.shape[:2]
    x, y = uv[:, 0].double() * w - 0.5, (1 - uv[:, 1].double()) * h - 0.5
    x0, y0 = x.detach().floor(), y.detach().floor()
    fx, fy = (x - x0).to(texture.dtype)[:, None], (y - y0).to(texture.dtype)[:, None]
    flat = texture.reshape(h * w, -1)

    def texels(dy: int, dx: int) -> Tensor:
        return rows_of(flat, wrapped(y0 + dy, h, wraps[1]) * w + wrapped(x0 + dx, w, wraps[0]))

    top = (1 - fx) * texels(0, 0) + fx * texels(0, 1)
    bottom = (1 - fx) * texels(1, 0) + fx * texels(1, 1)
    return (1 - fy) * top + fy * bottom


def nearest(texture: Tensor, cell: Tensor, wraps: tuple[str, ...]) -> Tensor:
    """Texels (N, K) of cells (N, 2), counted from the left and from the top."""
    h, w = texture.shape[:2]
    return rows_of(texture.reshape(h * w, -1), wrapped(cell[:, 1], h, wraps[1]) * w + wrapped(cell[:, 0], w, wraps[0]))


def in_texels(texture: Tensor, uv: Tensor) -> Tensor:
    """(N, 2) float64: texture coordinates in texels, to the right and down."""
    h, w = texture.shape[:2]
    return torch.stack([uv[:, 0].double() * w, (1 - uv[:, 1].double()) * h], 1)


def look_up(texture: Tensor, uv: Tensor, wraps: tuple[str, ...], filter: str) -> Tensor:
    """(N, K) of a texture (h, w, K) at uv (N, 2): "linear", or "nearest", whose borders have no derivative."""
    if filter == "nearest":
        return nearest(texture, in_texels(texture, uv).detach().floor(), wraps)
    return bilinear(texture, uv, wraps)


def pyramid(texture: Tensor) -> list[Tensor]:
    """The texture, and its means over squares of 2, 4, 8 … texels."""
    levels = [texture]
    while max(levels[-1].shape[:2]) > 1:
        image = levels[-1].movedim(-1, 0)[None]
        size = max(1, image.shape[2] // 2), max(1, image.shape[3] // 2)
        levels.append(torch.nn.functional.adaptive_avg_pool2d(image, size)[0].movedim(0, -1))
    return levels


def trilinear(levels: list[Tensor], level: Tensor, uv: Tensor, wraps: tuple[str, ...]) -> Tensor:
    """(N, K) between the two levels of a pyramid around `level` (N,)."""
    level = level.clamp(0, len(levels) - 1)
    below = level.floor()
    value: Any = 0
    for k, image in enumerate(levels):
        weight = torch.where(below == k, 1 - (level - below), torch.where(below == k - 1, level - below, 0.0))
        value = value + weight.to(image.dtype)[:, None] * bilinear(image, uv, wraps)
    return value
