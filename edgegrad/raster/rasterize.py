"""The triangle that covers each pixel's centre, and where in it."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..check import as_int, check_int
from ..kernel.threads import threads
from ..library import core
from .tensors import check_positions, contiguous, ranges_of, to_kernel, triangles


class RasterizeContext:
    """Base class of both contexts, which hold one choice and no resources."""

    def __init__(self, output_db: bool = True, mode: str = "automatic", device: Any = None) -> None:
        if mode not in ("automatic", "manual"):
            raise ValueError(f"mode: expected 'automatic' or 'manual', got {mode!r}")
        self.output_db = bool(output_db)

    def set_context(self) -> None:
        """Do nothing: there is no context of a graphics library."""

    def release_context(self) -> None:
        """Do nothing: there is no context of a graphics library."""


class RasterizeGLContext(RasterizeContext):
    """A context for `rasterize`, which here holds one choice and no resources. Raises ValueError for another mode.

    Parameters
    ----------
    output_db : bool, default True
        Whether derivatives of barycentrics in the image are returned.
    mode : "automatic" or "manual"
        Both do the same here.
    device
        Ignored: results are on the device of `pos`.
    """


class RasterizeCudaContext(RasterizeContext):
    """A context for `rasterize` under the name, and with the arguments, that scripts use. It needs no CUDA."""

    def __init__(self, device: Any = None) -> None:
        super().__init__(device=device)


_log_level = 1


def set_log_level(level: int) -> None:
    """Remember a level, 0 to 3, for scripts that set one. Nothing is logged here: errors are raised."""
    global _log_level
    _log_level = check_int("level", level, 0, 3)


def get_log_level() -> int:
    """Return the level of `set_log_level`, 1 at first."""
    return _log_level


def rasterize(
    ctx: RasterizeCudaContext | RasterizeGLContext,
    pos: Tensor,
    tri: Tensor,
    resolution: Sequence[int],
    ranges: Tensor | None = None,
    grad_db: bool = True,
) -> tuple[Tensor, Tensor]:
    """Return the nearest surface at the centre of each pixel, in two tensors of the dtype and on the device of `pos`.

    The first is (B, H, W, 4): u, v, z/w and the triangle + 1; all 0 where there is none. u and v are the barycentrics of the
    first two vertices, in space, not in the image. The second is (B, H, W, 4): ∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y for a pixel to the
    right and up; (B, H, W, 0) if the context says so.

    A centre on an edge that two triangles share belongs to exactly one of them, by exact arithmetic. Of surfaces at the same
    depth the first in `tri` is seen. Gradients of u, v and their derivatives go to x, y and w of `pos`. z/w has none, and what
    moves at silhouettes gets its gradient in `antialias`. A float32 can name 2²⁴ triangles; give float64 positions for more.
    Raises TypeError or ValueError that names the argument.

    Parameters
    ----------
    ctx : RasterizeCudaContext or RasterizeGLContext
    pos : (B, V, 4) float, or (V, 4) for all images with `ranges`
        Vertices of each image in clip space: −w ≤ x, y, z ≤ w is seen, the smaller z/w the nearer.
    tri : (F, 3) int
        Vertices of the triangles.
    resolution : (height, width) in pixels
        Row 0 is at the bottom, y = −w.
    ranges : (B, 2) int
        For each image the first of its triangles and how many; with pos (V, 4), else ignored.
    grad_db : bool, default True
        Whether gradients of the second result go to `pos`.
    """
    return _Arguments.checked(ctx, pos, tri, resolution, ranges, grad_db).layer(None)


class DepthPeeler:
    """Surfaces behind one another, layer by layer; arguments as of `rasterize`.

        with DepthPeeler(ctx, pos, tri, resolution) as peeler:
            rast, rast_db = peeler.rasterize_next_layer()

    A layer is the nearest surface whose z/w is larger than that of the layer before, in the dtype of `pos`.
    """

    def __init__(
        self,
        ctx: RasterizeContext,
        pos: Tensor,
        tri: Tensor,
        resolution: Sequence[int],
        ranges: Tensor | None = None,
        grad_db: bool = True,
    ) -> None:
        self._arguments = _Arguments.checked(ctx, pos, tri, resolution, ranges, grad_db)
        self._behind: Tensor | None = None
        self._open = False

    def __enter__(self) -> DepthPeeler:
        self._open, self._behind = True, None
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open, self._behind = False, None

    def rasterize_next_layer(self) -> tuple[Tensor, Tensor]:
        """Return what `rasterize` returns. Raises RuntimeError outside of `with`."""
        if not self._open:
            raise RuntimeError("rasterize_next_layer: expected a call within `with DepthPeeler(…) as peeler:`")
        rast, rast_db = self._arguments.layer(self._behind)
        known = rast.detach().cpu()
        self._behind = torch.where(known[..., 3] > 0, known[..., 2], torch.inf).contiguous()
        return rast, rast_db


class _Arguments(NamedTuple):
    pos: Tensor  # (1 or B, V, 4)
    tri: Tensor
    ranges: Tensor | None
    size: tuple[int, int]
    derivatives: bool
    grad_db: bool
    device: torch.device

    @classmethod
    def checked(cls, ctx: Any, pos: Any, tri: Any, resolution: Sequence[int], ranges: Any, grad_db: bool) -> _Arguments:
        if not isinstance(ctx, RasterizeContext):
            raise TypeError(f"ctx: expected a RasterizeCudaContext or RasterizeGLContext, got {type(ctx).__name__}")
        (pos,), device = to_kernel(pos=pos)
        if pos.dim() not in (2, 3) or pos.shape[-1] != 4:
            raise ValueError(f"pos: expected shape (B, V, 4), or (V, 4) with ranges, got {tuple(pos.shape)}")
        check_positions(pos)
        if not hasattr(resolution, "__len__") or len(resolution) != 2:
            raise ValueError(f"resolution: expected (height, width), got {resolution!r}")
        height, width = (as_int("resolution", n) for n in resolution)
        if not (0 < height <= 32768 and 0 < width <= 32768):
            raise ValueError(f"resolution: expected a height and a width from 1 to 32768, got {(height, width)}")
        faces = triangles(tri, pos.shape[-2], "pos")
        if pos.dim() == 3:
            ranges = None
        elif ranges is None:
            raise ValueError(
                "ranges: expected (B, 2) with positions of shape (V, 4), got None; for one image use pos[None]"
            )
        else:
            ranges = ranges_of(ranges, len(faces))
        if pos.dtype == torch.float32 and len(faces) >= 2**24:
            raise ValueError(
                f"tri: expected fewer than 2²⁴ triangles, which a float32 can name, got {len(faces)}; use pos.double()"
            )
        derivatives = ctx.output_db
        whole = pos if pos.dim() == 3 else pos[None]
        return cls(whole, faces, ranges, (height, width), derivatives, derivatives and bool(grad_db), device)

    def layer(self, behind: Tensor | None) -> tuple[Tensor, Tensor]:
        rast, rast_db = _Rasterize.apply(self, self.pos, behind)
        return rast.to(self.device), rast_db.to(self.device)


class _Rasterize(torch.autograd.Function):
    """The operator of csrc/raster/rasterize.h."""

    @staticmethod
    def forward(ctx: Any, arguments: _Arguments, pos: Tensor, behind: Tensor | None) -> tuple[Tensor, Tensor]:
        tri, ranges = contiguous(arguments.tri), contiguous(arguments.ranges)
        found = core.rasterize(
            contiguous(pos),
            tri,
            ranges,
            *arguments.size,
            contiguous(behind),
            arguments.derivatives,
            threads(),
        )
        rast, rast_db = map(torch.from_numpy, found)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(pos, rast)
        ctx.arguments = arguments._replace(pos=pos.detach())
        return rast, rast_db

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        rast_bar, db_bar = grad_outputs
        pos, rast = ctx.saved_tensors
        arguments = ctx.arguments
        if not arguments.grad_db:
            db_bar = None
        if rast_bar is None and db_bar is None:
            return None, None, None
        bar = torch.zeros_like(rast) if rast_bar is None else rast_bar
        tri, ranges = contiguous(arguments.tri), contiguous(arguments.ranges)
        found = core.rasterize_vjp(
            contiguous(pos), tri, ranges, contiguous(rast), contiguous(bar), contiguous(db_bar), threads()
        )
        return None, torch.from_numpy(found), None
