"""Attributes of vertices at the points that a rasterizer found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..check import as_int
from ..kernel.threads import threads
from ..library import core
from .tensors import check_image, contiguous, to_kernel, triangles


def interpolate(
    attr: Tensor,
    rast: Tensor,
    tri: Tensor,
    rast_db: Tensor | None = None,
    diff_attrs: Sequence[int] | Literal["all"] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return attributes of vertices, interpolated in each pixel's triangle, and their derivatives in the image.

    Gradients go to `attr`, to u and v of `rast`, and to `rast_db`. TypeError and ValueError name a wrong argument.

    Parameters
    ----------
    attr : (B, V, A) float, or (1, V, A) or (V, A) for all images
    rast, rast_db : (B, H, W, 4) float
        The results of `rasterize`.
    tri : (F, 3) int
        Vertices of the triangles.
    diff_attrs : sequence of int, or "all", default none
        Numbers of the attributes whose derivatives in the image are wanted; with `rast_db`.

    Returns
    -------
    attributes : Tensor
        (B, H, W, A), zero where there is no triangle.
    derivatives : Tensor
        (B, H, W, 2 len(diff_attrs)): ∂a/∂X and ∂a/∂Y of each, for a pixel to the right and up; or (B, H, W, 0).
    """
    if rast_db is not None and diff_attrs is None and tuple(rast_db.shape[3:]) == (0,):
        rast_db = None  # of a context without derivatives
    given = {"attr": attr, "rast": rast} | ({} if rast_db is None else {"rast_db": rast_db})
    (attr, rast, *more), device = to_kernel(**given)
    rast_db = more[0] if more else None
    check_image("rast", rast, 4)
    if rast_db is not None:
        if rast_db.dim() == 4 and rast_db.shape[3] == 0:
            raise ValueError(
                "rast_db: expected derivatives for diff_attrs, got none; use a context with output_db=True"
            )
        check_image("rast_db", rast_db, 4, like=rast)
    if attr.dim() == 2:
        attr = attr[None]
    if attr.dim() != 3 or attr.shape[2] < 1 or attr.shape[0] not in (1, len(rast)):
        raise ValueError(
            f"attr: expected shape ({len(rast)}, V, A), (1, V, A) or (V, A) with A ≥ 1 for {len(rast)} images, "
            f"got {tuple(attr.shape)}"
        )
    faces = triangles(tri, attr.shape[1], "attr")
    chosen = _chosen(diff_attrs, attr.shape[2]) if rast_db is not None else []
    values, da = _Interpolate.apply(faces, chosen, attr, rast, rast_db if chosen else None)
    return values.to(device), da.to(device)


def _chosen(diff_attrs: Sequence[int] | str | None, width: int) -> list[int]:
    if diff_attrs is None:
        return []
    if isinstance(diff_attrs, str):
        if diff_attrs != "all":
            raise ValueError(f"diff_attrs: expected numbers of attributes or 'all', got {diff_attrs!r}")
        return list(range(width))
    if not hasattr(diff_attrs, "__len__"):
        raise TypeError(
            f"diff_attrs: expected numbers of attributes or 'all', got {diff_attrs!r}; use [{diff_attrs!r}]"
        )
    chosen = [as_int("diff_attrs", k) for k in diff_attrs]
    for k in chosen:
        if not 0 <= k < width:
            raise ValueError(f"diff_attrs: expected numbers from 0 to {width - 1}, got {k}")
    return chosen


class _Interpolate(torch.autograd.Function):
    """The operator of csrc/raster/interpolate.h."""

    @staticmethod
    def forward(
        ctx: Any, tri: Tensor, chosen: list[int], attr: Tensor, rast: Tensor, rast_db: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        arrays = contiguous(attr), contiguous(rast), contiguous(tri), contiguous(rast_db)
        values, da = map(torch.from_numpy, core.interpolate(*arrays, chosen, threads()))
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(attr, rast, tri, rast_db)
        ctx.chosen = chosen
        return values, da

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        bar, da_bar = grad_outputs
        arrays = [contiguous(tensor) for tensor in ctx.saved_tensors]
        if not ctx.chosen:
            da_bar = None
        if bar is None and da_bar is None:
            return (None,) * 5
        wanted = [bool(want) for want in ctx.needs_input_grad[2:]]
        found = core.interpolate_vjp(*arrays, ctx.chosen, contiguous(bar), contiguous(da_bar), wanted, threads())
        return None, None, *(None if grad is None else torch.from_numpy(grad) for grad in found)
