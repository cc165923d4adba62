"""Pixels blended across silhouettes, with what that says of the vertices."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..check import as_scalar, check_positive_int
from ..kernel.threads import threads
from ..library import core
from ..sampling import drawn_seed
from .exact import exact_means
from .tensors import check_image, check_positions, contiguous, ranges_of, to_kernel, triangles


class TopologyHash:
    """The edges that triangles share, from `antialias_construct_topology_hash`."""

    def __init__(self, tri: Tensor) -> None:
        self.tri = tri
        count = 3 * len(tri)
        # Half-edge 3 t + i lies opposite to corner i of triangle t.
        ends = torch.stack([tri.roll(-1, 1), tri.roll(-2, 1)], 2).reshape(-1, 2).long()
        key = ends.amin(1) * (2**31) + ends.amax(1)
        order = torch.argsort(key, stable=True)
        _, of_sorted, sizes = torch.unique_consecutive(key[order], return_inverse=True, return_counts=True)
        group = torch.empty(count, dtype=torch.int32)
        group[order] = of_sorted.int()
        start = torch.zeros(len(sizes) + 1, dtype=torch.int32)
        start[1:] = sizes.cumsum(0)
        self.groups = core.EdgeGroups(group.numpy(), start.numpy(), order.int().numpy())

    def __reduce__(self) -> tuple[type[TopologyHash], tuple[Tensor]]:
        return TopologyHash, (self.tri,)


def antialias_construct_topology_hash(tri: Tensor) -> TopologyHash:
    """Return which triangles share edges, for `antialias`, which otherwise finds it at each call. Raises TypeError or
    ValueError that names the argument.

    Parameters
    ----------
    tri : (F, 3) int
    """
    return TopologyHash(triangles(tri, 2**31 - 1, "pos").clone())


def antialias(
    color: Tensor,
    rast: Tensor,
    pos: Tensor,
    tri: Tensor,
    topology_hash: TopologyHash | None = None,
    pos_gradient_boost: float = 1.0,
    *,
    exact: bool = False,
    ranges: Tensor | None = None,
    spp: int = 16,
    seed: int | None = None,
) -> Tensor:
    """Return an image whose pixels are blended across silhouettes, so that it changes continuously with the vertices, (B, H, W,
    C).

    Where two pixels side by side, or above each other, show different triangles and the nearer of these ends between their
    centres with a silhouette (an edge of one triangle, or of several on the same side in the image), the pixel that the edge
    cuts is blended with the other, by half a pixel less the distance of the edge from the centre. Edges that run more up than
    along count between pixels side by side, others between those above each other (Laine et al. 2020, section 3.5). Gradients
    go to `color` and to x, y and w of `pos`: the exact derivatives of what is returned. They cover silhouettes whose triangle
    is seen at a pixel's centre.

    With `exact` a pixel becomes the mean over its area, by `spp` samples, of the colours of what they hit, and the gradient is
    that of this mean. It is unbiased, also where triangles are small or seen from their edge and no centre shows them. A
    sample's colour is that of the pixel, among the nine around it, that shows its triangle; if none does, of another one that
    does; if none in the image does, of the one of the nine that shows the surface nearest in depth. Background has the colour
    of the nearest pixel without a triangle. Edges between triangles of one surface count, too. Raises TypeError or ValueError
    that names the argument.

    Parameters
    ----------
    color : (B, H, W, C) float
    rast : (B, H, W, 4) float
        The first result of `rasterize`.
    pos, tri : (B, V, 4) or (V, 4) float, and (F, 3) int
        The positions and triangles that were rasterized.
    topology_hash : TopologyHash
        Result of `antialias_construct_topology_hash`; None: made here.
    pos_gradient_boost : float, default 1
        Factor of the gradient of `pos`.
    exact : bool, default False
        Whether pixels become means.
    ranges : (B, 2) int
        With `exact` and pos (V, 4): those that were rasterized.
    spp : int, default 16
        With `exact`: samples per pixel.
    seed : int, optional
        With `exact`: of the samples; by default torch's generator draws one for each image.
    """
    (color, rast, pos), device = to_kernel(color=color, rast=rast, pos=pos)
    check_image("rast", rast, 4)
    check_image("color", color, "C", like=rast)
    if pos.dim() == 2:
        pos = pos[None]
    if pos.dim() != 3 or pos.shape[2] != 4 or pos.shape[0] not in (1, len(rast)):
        raise ValueError(f"pos: expected shape ({len(rast)}, V, 4) or (V, 4), got {tuple(pos.shape)}")
    faces = triangles(tri, pos.shape[1], "pos")
    check_positions(pos)
    boost = float(as_scalar("pos_gradient_boost", pos_gradient_boost, like=pos))
    if not math.isfinite(boost):
        raise ValueError(f"pos_gradient_boost: expected a finite number, got {boost}")
    if exact:
        spans = _spans(ranges, pos, faces, len(rast))
        known = pos if boost == 1 else pos.detach() + boost * (pos - pos.detach())
        spp = check_positive_int("spp", spp)
        images = []
        for b, (first, count) in enumerate(spans):
            own = faces[first : first + count]
            counted = rast[b].clone()
            _check_shown(b, rast[b, ..., 3], first, count)
            counted[..., 3] = torch.where(counted[..., 3] > 0, counted[..., 3] - first, 0)
            images.append(
                exact_means(color[b], counted, known[b if len(known) > 1 else 0], own, spp, int(drawn_seed(seed)))
            )
        return torch.stack(images).to(device)
    if topology_hash is None:
        topology_hash = TopologyHash(faces)
    elif not isinstance(topology_hash, TopologyHash):
        raise TypeError(
            "topology_hash: expected what antialias_construct_topology_hash returns, got "
            + type(topology_hash).__name__
        )
    elif not torch.equal(topology_hash.tri, faces):
        raise ValueError(
            f"topology_hash: expected that of these {len(faces)} triangles, got one of {len(topology_hash.tri)} others; "
            "make it of tri anew"
        )
    return _Antialias.apply(color, pos, rast.detach(), faces, topology_hash.groups, boost).to(device)


def _spans(ranges: Tensor | None, pos: Tensor, tri: Tensor, images: int) -> list[list[int]]:
    """Return the first triangle of each image and how many."""
    if ranges is None:
        if len(pos) != images:
            raise ValueError(
                "ranges: expected those that were rasterized, for positions of all images and exact=True, got None"
            )
        return [[0, len(tri)]] * images
    known = ranges_of(ranges, len(tri))
    if len(pos) != 1 or len(known) != images:
        raise ValueError(f"ranges: expected shape ({images}, 2) with positions (V, 4), got {tuple(known.shape)}")
    return known.tolist()


def _check_shown(image: int, number: Tensor, first: int, count: int) -> None:
    """Check that each pixel (H, W) has 0, or a triangle of the image + 1. Raises ValueError."""
    fine = (number == 0) | ((number >= first + 1) & (number <= first + count) & (number == number.round()))
    if not bool(fine.all()):
        y, x = (~fine).nonzero()[0].tolist()
        raise ValueError(
            f"rast: expected numbers of triangles from {first + 1} to {first + count}, or 0, in the last channel, "
            f"got {number[y, x].item()} at [{image}, {y}, {x}, 3]; give the tri that was rasterized"
        )


class _Antialias(torch.autograd.Function):
    """The operator of csrc/raster/antialias.h."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, pos: Tensor, rast: Tensor, tri: Tensor, groups: Any, boost: float) -> Tensor:
        ctx.crossings = core.find_crossings(contiguous(pos), contiguous(tri), groups, contiguous(rast), threads())
        ctx.save_for_backward(color, pos, tri)
        ctx.boost = boost
        return torch.from_numpy(core.antialias(ctx.crossings, contiguous(color), threads()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        (bar,) = grad_outputs
        color, pos, tri = map(contiguous, ctx.saved_tensors)
        wanted = [bool(want) for want in ctx.needs_input_grad[:2]]
        found = core.antialias_vjp(ctx.crossings, pos, tri, color, contiguous(bar), wanted, threads())
        color_bar, pos_bar = (None if grad is None else torch.from_numpy(grad) for grad in found)
        if pos_bar is not None and ctx.boost != 1:
            pos_bar = pos_bar * ctx.boost
        return color_bar, pos_bar, None, None, None, None
