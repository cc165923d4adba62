"""Texture look-ups at texture coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

from .rows import rows_of


def wrapped(cell: Tensor, count: int | Tensor, wrap: str) -> Tensor:
    """Return texels as they are counted in the texture, int64; of `count` texels, or (N,) of textures of their own."""
    i = cell.detach().long()
    if wrap == "repeat":
        return i % count
    if wrap == "clamp":
        return torch.minimum(i.clamp(min=0), torch.as_tensor(count - 1, device=i.device))
    i = i % (2 * count)
    return torch.minimum(i, 2 * count - 1 - i)


def adjacent(cell: Tensor, count: int | Tensor, wrap: str) -> list[Tensor]:
    """Return the texels, as wrapped() does, of cells and of those after them."""
    return [wrapped(cell + k, count, wrap) for k in (0, 1)]


def bilinear(texture: Tensor, uv: Tensor, wraps: tuple[str, ...]) -> Tensor:
    h, w = texture.shape[:2]
    return bilinear_of_rows(texture.reshape(h * w, -1), 0, h, w, uv, wraps)


def bilinear_of_rows(
    texels: Tensor, first: int | Tensor, h: int | Tensor, w: int | Tensor, uv: Tensor, wraps: tuple[str, ...]
) -> Tensor:
    """Interpolate textures h by w, row by row from the row `first` of texels (M, K): one, or (N,) one for each point."""
    x, y = uv[:, 0].double() * w - 0.5, (1 - uv[:, 1].double()) * h - 0.5
    x0, y0 = x.detach().floor(), y.detach().floor()
    fx, fy = (x - x0).to(texels.dtype)[:, None], (y - y0).to(texels.dtype)[:, None]
    columns, rows = adjacent(x0, w, wraps[0]), adjacent(y0, h, wraps[1])

    def across(row: Tensor) -> Tensor:
        left, right = (rows_of(texels, first + row * w + column) for column in columns)
        return (1 - fx) * left + fx * right

    return (1 - fy) * across(rows[0]) + fy * across(rows[1])


def nearest(texture: Tensor, cell: Tensor, wraps: tuple[str, ...]) -> Tensor:
    """Return texels (N, K) of cells (N, 2), counted from the left and from the top."""
    h, w = texture.shape[:2]
    return rows_of(texture.reshape(h * w, -1), wrapped(cell[:, 1], h, wraps[1]) * w + wrapped(cell[:, 0], w, wraps[0]))


def in_texels(texture: Tensor, uv: Tensor) -> Tensor:
    """Return texture coordinates (N, 2) float64 in texels, to the right and down."""
    h, w = texture.shape[:2]
    return torch.stack([uv[:, 0].double() * w, (1 - uv[:, 1].double()) * h], 1)


def look_up(texture: Tensor, uv: Tensor, wraps: tuple[str, ...], filter: str) -> Tensor:
    """Return (N, K) of a texture (h, w, K) at uv (N, 2): "linear", or "nearest", whose borders have no derivative."""
    if filter == "nearest":
        return nearest(texture, in_texels(texture, uv).detach().floor(), wraps)
    return bilinear(texture, uv, wraps)
