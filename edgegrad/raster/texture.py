"""Look-ups in textures, cube maps and their pyramids."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..check import as_tensor, check_choice, check_finite, check_int
from ..kernel.threads import threads
from ..library import core
from .tensors import check_image, contiguous, to_kernel

FILTERS = ("auto", "nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear")
BORDERS = ("wrap", "clamp", "zero", "cube")


class Mipmaps(NamedTuple):
    """The levels of a texture above the texture itself, from `texture_construct_mip`."""

    levels: tuple[Tensor, ...]
    size: tuple[int, ...]  # of the texture


def texture_construct_mip(tex: Tensor, max_mip_level: int | None = None, cube_mode: bool = False) -> Mipmaps:
    """Return means of a texture over squares of 2, 4, 8 … texels, made once for many calls of `texture`.

    Give the result to `texture` as `mip`, with the same `tex`, to which the gradients then go. Raises ValueError where a side
    is odd, unless it is 1 or `max_mip_level` ends before.

    Parameters
    ----------
    tex : (B, h, w, C) float, or (B, 6, h, h, C) for cubes
    max_mip_level : int, default down to one texel
        The last level that is made.
    cube_mode : bool, default False
        Whether it is a cube.
    """
    (tex,), _ = to_kernel(tex=tex)
    _check_texture(tex, cube_mode)
    most = None if max_mip_level is None else check_int("max_mip_level", max_mip_level, 0, 2**31 - 1)
    return Mipmaps(tuple(_levels_of(tex.detach(), most)), tuple(tex.shape))


def texture(
    tex: Tensor,
    uv: Tensor,
    uv_da: Tensor | None = None,
    mip_level_bias: Tensor | None = None,
    mip: Mipmaps | Sequence[Tensor] | None = None,
    filter_mode: str = "auto",
    boundary_mode: str = "wrap",
    max_mip_level: int | None = None,
) -> Tensor:
    """Return a texture at the coordinates of each pixel, (B, H, W, C).

    The level is log2 of the longer axis of the ellipse of texels that a pixel sees (Williams 1983). Across the edges of a cube
    texels are taken from both sides; where three meet, the fourth is their mean. Directions of zero length, or not finite, give
    zeros and no gradient. Gradients go to `tex`, `uv`, `uv_da`, `mip_level_bias` and the levels of a list. Raises TypeError or
    ValueError that names the argument.

    Parameters
    ----------
    tex : (B, h, w, C) float, or (B, 6, h, h, C) for cubes
        Sides of cubes are +x, −x, +y, −y, +z, −z with OpenGL's axes. B may be 1. Texel [0, 0] is at (u, v) = (0, 0), v runs
        with the rows.
    uv : (B, H, W, 2) float, or directions (B, H, W, 3) of any length for cubes
    uv_da : (B, H, W, 4) float, or 6
        ∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y a pixel, as `interpolate` returns.
    mip_level_bias : (B, H, W) float
        Added to the level; the level itself without `uv_da`.
    mip : Mipmaps, or a list of levels of your own, default made here
        The levels of a list get gradients of their own.
    filter_mode : "nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear" or "auto"
        "auto" is the last with `uv_da` or `mip_level_bias`, else "linear".
    boundary_mode : "wrap", "clamp", "zero" or "cube"
        "clamp" continues the outermost texels' centres, "zero" is black beyond the texture.
    max_mip_level : int
        The last level that is used.
    """
    check_choice("filter_mode", filter_mode, FILTERS)
    check_choice("boundary_mode", boundary_mode, BORDERS)
    if filter_mode == "auto":
        filter_mode = "linear" if uv_da is None and mip_level_bias is None else "linear-mipmap-linear"
    by_level = "mipmap" in filter_mode
    if by_level and uv_da is None and mip_level_bias is None:
        raise ValueError(f"uv_da: expected it, or mip_level_bias, for filter_mode {filter_mode!r}, got None")
    most = None if max_mip_level is None else check_int("max_mip_level", max_mip_level, 0, 2**31 - 1)
    own = mip is not None and not isinstance(mip, Mipmaps)
    if own and not isinstance(mip, Sequence):
        raise TypeError(f"mip: expected that of texture_construct_mip, or a list of levels, got {type(mip).__name__}")
    levels = list(mip) if mip is not None and own and by_level else []
    given = {
        "uv": uv,
        "tex": tex,
        "uv_da": uv_da if by_level else None,
        "mip_level_bias": mip_level_bias if by_level else None,
    }
    given |= {f"mip[{k}]": level for k, level in enumerate(levels)}
    moved, device = to_kernel(**{name: value for name, value in given.items() if value is not None})
    there = dict(zip((name for name, value in given.items() if value is not None), moved, strict=True))
    uv, tex, levels = there["uv"], there["tex"], [there[f"mip[{k}]"] for k in range(len(levels))]
    cube = boundary_mode == "cube"
    _check_texture(tex, cube)
    _check_coordinates(uv, there.get("uv_da"), there.get("mip_level_bias"), len(tex), cube)

    if not by_level:
        texels, count = tex.reshape(-1), 1
    elif own:
        _check_levels(tex, levels)
        used = levels[:most]
        texels, count = torch.cat([level.reshape(-1) for level in (tex, *used)]), 1 + len(used)
    else:
        made = (_made(mip, tex) if isinstance(mip, Mipmaps) else _levels_of(tex.detach(), most))[:most]
        texels, count = _Pyramid.apply(tex, *made), 1 + len(made)
    shape = [len(tex), *tex.shape[-3:], count]
    options = core.TextureOptions(shape, boundary_mode, filter_mode)
    return _Sample.apply(options, texels, uv, there.get("uv_da"), there.get("mip_level_bias")).to(device)


def _check_texture(tex: Tensor, cube: bool) -> None:
    if cube:
        if tex.dim() != 5 or tex.shape[1] != 6 or tex.shape[2] != tex.shape[3] or 0 in tex.shape:
            raise ValueError(f"tex: expected shape (B, 6, h, h, C) of cubes, got {tuple(tex.shape)}")
    elif tex.dim() != 4 or 0 in tex.shape:
        fix = "; set boundary_mode='cube' (cube_mode=True) for cubes" if tex.dim() == 5 else ""
        raise ValueError(f"tex: expected shape (B, h, w, C), got {tuple(tex.shape)}{fix}")


def _check_coordinates(uv: Tensor, uv_da: Tensor | None, bias: Tensor | None, textures: int, cube: bool) -> None:
    width = 3 if cube else 2
    check_image("uv", uv, width)
    if not cube:
        check_finite("uv", uv)
    if textures not in (1, len(uv)):
        raise ValueError(f"tex: expected {len(uv)} textures, one for each image of uv, or 1, got {textures}")
    if uv_da is not None:
        check_image("uv_da", uv_da, 2 * width, like=uv)
    if bias is not None and bias.shape != uv.shape[:3]:
        raise ValueError(f"mip_level_bias: expected shape {tuple(uv.shape[:3])}, got {tuple(bias.shape)}")


def _halved(size: torch.Size) -> tuple[int, int]:
    return max(1, size[-3] // 2), max(1, size[-2] // 2)


def _check_levels(tex: Tensor, levels: list[Tensor]) -> None:
    last = tex
    for k, level in enumerate(levels):
        expected = (*tex.shape[:-3], *_halved(last.shape), tex.shape[-1])
        if max(last.shape[-3:-1]) == 1 or level.shape != expected:
            what = "no level above one texel" if max(last.shape[-3:-1]) == 1 else f"shape {expected}"
            raise ValueError(
                f"mip[{k}]: expected {what}, got {tuple(level.shape)}; a level has half the size of the last"
            )
        last = level


def _levels_of(tex: Tensor, most: int | None) -> list[Tensor]:
    """Return the means over two by two texels, of these again, and so on."""
    levels: list[Tensor] = []
    last = tex
    while max(last.shape[-3:-1]) > 1 and (most is None or len(levels) < most):
        height, width = last.shape[-3:-1]
        if (height > 1 and height % 2) or (width > 1 and width % 2):
            raise ValueError(
                f"tex: expected sides that can be halved at each level, got {tuple(tex.shape[-3:-1])}, whose level "
                f"{len(levels)} is {height} by {width}; use powers of two, or max_mip_level={len(levels)}"
            )
        last = (
            last.unflatten(-2, (_halved(last.shape)[1], -1)).unflatten(-4, (_halved(last.shape)[0], -1)).mean((-4, -2))
        )
        levels.append(last.contiguous())
    return levels


def _made(mip: Mipmaps, tex: Tensor) -> list[Tensor]:
    if mip.size != tuple(tex.shape):
        raise ValueError(
            f"mip: expected that of a texture of shape {tuple(tex.shape)}, got one of {mip.size}; make it anew"
        )
    return [as_tensor("mip", level).to(tex.dtype) for level in mip.levels]


class _Pyramid(torch.autograd.Function):
    """A texture and the levels that were made of it, one after the other: gradients of levels go to the texture."""

    @staticmethod
    def forward(ctx: Any, tex: Tensor, *levels: Tensor) -> Tensor:
        ctx.sizes = [level.shape for level in (tex, *levels)]
        return torch.cat([level.reshape(-1) for level in (tex, *levels)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        (bar,) = grad_outputs
        bars = [
            part.view(size) for part, size in zip(bar.split([s.numel() for s in ctx.sizes]), ctx.sizes, strict=True)
        ]
        found = bars[-1]
        for below in reversed(bars[:-1]):
            tall, wide = (2 if n > 1 else 1 for n in below.shape[-3:-1])
            share = found / (tall * wide)
            found = below + share.repeat_interleave(tall, -3).repeat_interleave(wide, -2)
        return found, *(None,) * (len(bars) - 1)


class _Sample(torch.autograd.Function):
    """The operator of csrc/raster/sample_texture.h."""

    @staticmethod
    def forward(ctx: Any, options: Any, *tensors: Tensor | None) -> Tensor:
        ctx.save_for_backward(*tensors)
        ctx.options = options
        return torch.from_numpy(core.sample_texture(options, *map(contiguous, tensors), threads()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        (bar,) = grad_outputs
        arrays = [contiguous(tensor) for tensor in ctx.saved_tensors]
        wanted = [bool(want) for want in ctx.needs_input_grad[1:]]
        found = core.sample_texture_vjp(ctx.options, *arrays, contiguous(bar), wanted, threads())
        return None, *(None if grad is None else torch.from_numpy(grad) for grad in found)
