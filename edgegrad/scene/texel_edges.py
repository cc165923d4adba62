"""Texel edges on the faces of a mesh whose texture gives the nearest texel: where what a surface emits jumps.

On a face a texture's coordinate p, in texels, is affine in the barycentrics b. So a texel edge p = i is a straight line in
them. The edges of the other coordinate divide it into segments between two texels each. An integral of
E(p(b)) h(b) over a face then has the derivative

    Σ_segments ∫ [E_i − E_{i−1}] h δp / |∇p| dℓ,

with lengths and ∇ in the last two barycentrics, and δp at fixed b.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .appearance import coordinates
from .environment import pick
from .material import Texture
from .mesh import Mesh
from .rows import interpolated
from .textures import in_texels, nearest

MOST_LINES = 1 << 17  # that are divided: of more some stand for all
MOST_SEGMENTS = 1 << 18


class TexelEdgePoints(NamedTuple):
    """N points on texel edges, and what each stands for: the jump over the pdf by its face's area times |∇p|."""

    face: Tensor  # (N,) int64
    b: Tensor  # (N, 3) float64
    axis: Tensor  # (N,) int64, which coordinate has the edge: 0 across, 1 down
    weight: Tensor  # (N, C) float64, times δp


class TexelEdges(NamedTuple):
    """Segments of texel edges, of all faces of a mesh."""

    mesh: Mesh
    texture: Texture
    face: Tensor  # (M,) int64
    begin: Tensor  # (M, 3) float64, barycentrics of the ends
    end: Tensor
    axis: Tensor  # (M,) int64
    jump: Tensor  # (M, C) float64: the texel on the side of greater coordinates less the other
    running: Tensor  # (M,) float64: the running sum of mean |jump| · dA / |∇p|

    @classmethod
    def from_mesh(cls, mesh: Mesh, texture: Texture, area: Tensor, u: tuple[float, float]) -> TexelEdges | None:
        """Return the texel edges of faces with these areas (F,), or None where none has a jump. Numbers u in [0, 1) pick the
        edges, and the segments of these, that stand for all where there are too many."""
        uvs, uv_faces = coordinates(mesh, texture)
        image = texture.image.detach().cpu()
        corners = in_texels(image, uvs.detach().cpu())[uv_faces.cpu().long()]  # (F, 3, 2)
        found = _TexelEdgeLines.from_corners(corners, u[0]).segments(corners, u[1])
        i, j, across = found.edge, found.cell, (found.axis == 0)
        high = torch.stack([torch.where(across, i, j), torch.where(across, j, i)], 1)
        low = high - torch.stack([across.double(), 1 - across.double()], 1)
        jump = (nearest(image, high, texture.wraps) - nearest(image, low, texture.wraps)).double()
        if texture.factor is not None:
            jump = jump * torch.as_tensor(texture.factor).detach().cpu().double()
        measure = found.share * jump.abs().mean(1) * area.cpu().double()[found.face]
        some = (measure > 0).nonzero()[:, 0]
        if len(some) == 0:
            return None
        parts = found.face, found.begin, found.end, found.axis, jump
        face, begin, end, axis, jump = (part[some].to(uvs.device) for part in parts)
        return cls(mesh, texture, face, begin, end, axis, jump, measure[some].cumsum(0).to(uvs.device))

    def draw(self, u: Tensor) -> TexelEdgePoints:
        """Draw points from numbers u (N, 2) in [0, 1)."""
        k, _ = pick(self.running, u[:, 0])
        b = torch.lerp(self.begin[k], self.end[k], u[:, 1:2])
        jump = self.jump[k]
        weight = self.running[-1] * jump / jump.abs().mean(1, keepdim=True)
        return TexelEdgePoints(self.face[k], b, self.axis[k], weight)

    def motion(self, points: TexelEdgePoints) -> Tensor:
        """Return δp (N, 1) float64: zeros, whose derivatives are those of the texture's coordinates at fixed barycentrics."""
        uvs, uv_faces = coordinates(self.mesh, self.texture)
        uv = interpolated(points.b, uvs.double()[uv_faces[points.face].long()])
        p = in_texels(self.texture.image, uv).gather(1, points.axis[:, None])
        return p - p.detach()


class _Segments(NamedTuple):
    face: Tensor
    begin: Tensor
    end: Tensor
    axis: Tensor
    edge: Tensor  # (M,) float64, an integer
    cell: Tensor  # (M,) float64, an integer: between two edges of the other coordinate
    share: Tensor  # (M,) float64: twice the length over |∇p|, and how many it stands for


class _TexelEdgeLines(NamedTuple):
    face: Tensor  # (L,) int64
    axis: Tensor  # (L,) int64
    edge: Tensor  # (L,) float64
    weight: Tensor  # how many one stands for

    @classmethod
    def from_corners(cls, corners: Tensor, u: float) -> _TexelEdgeLines:
        faces = len(corners)
        first = corners.amin(1).ceil().T.reshape(-1)  # (2 F,), the first coordinate before the second
        count = (corners.amax(1).floor().T.reshape(-1) - first + 1).clamp(min=0)
        row, place, weight = _some(count, MOST_LINES, u)
        return cls(row % max(faces, 1), row // max(faces, 1), first[row] + place, weight)

    def segments(self, corners: Tensor, u: float) -> _Segments:
        """Return where they run through the triangles with these corners (F, 3, 2), in texels."""
        at = corners[self.face]  # (L, 3, 2)
        rows = torch.arange(len(self.face))
        p, q = at[rows, :, self.axis], at[rows, :, 1 - self.axis]  # (L, 3)
        order = p.argsort(1)
        low, mid, high = p.gather(1, order).unbind(1)
        one_hot = torch.eye(3, dtype=torch.float64)[
            order
        ]  # (L, 3, 3), barycentrics of the lowest, middle and highest corner

        def between(k: Tensor | int, m: Tensor | int, start: Tensor, end: Tensor) -> Tensor:
            t = torch.where(end > start, (self.edge - start) / (end - start), 0.0)[:, None]
            return torch.lerp(one_hot[rows, k], one_hot[rows, m], t)

        before = (self.edge < mid) | ((self.edge == mid) & (mid > low))
        k = torch.where(before, 0, 1)
        a = between(0, 2, low, high)
        b = between(k, k + 1, torch.where(before, low, mid), torch.where(before, mid, high))
        along = (q[:, None, :] @ torch.stack([a, b], 2))[:, 0]  # (L, 2) the other coordinate at both ends
        swap = along[:, 0] > along[:, 1]
        a, b = torch.where(swap[:, None], b, a), torch.where(swap[:, None], a, b)
        start, end = along.amin(1), along.amax(1)
        first = start.floor()
        count = torch.where(end > start, end.ceil() - first, 1.0)
        line, place, weight = _some(count, MOST_SEGMENTS, u)
        cell = first[line] + place
        span = (end - start)[line]
        s0, s1 = (
            torch.where(span > 0, (edge - start[line]) / span, float(k)).clamp(0, 1)[:, None]
            for k, edge in enumerate((cell, cell + 1))
        )
        gradient = (p[:, 1:] - p[:, :1]).norm(dim=1)
        length = (b - a)[:, 1:].norm(dim=1) / gradient
        # On an edge of the face: moved one way the texel edge enters it, and moved the other way its neighbour.
        on_edge = (p == self.edge[:, None]).sum(1) == 2
        share = 2 * length * torch.where(on_edge, 0.5, 1.0) * self.weight
        share = torch.where(gradient > 0, share, 0.0)[line] * (s1 - s0)[:, 0] * weight
        a, b = a[line], b[line]
        return _Segments(
            self.face[line], torch.lerp(a, b, s0), torch.lerp(a, b, s1), self.axis[line], self.edge[line], cell, share
        )


def _some(count: Tensor, most: int, u: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows (M,) and places in them of things of which each row has `count` (R,), and how many things each stands for.
    They are all, or evenly spaced ones where there are more than `most`."""
    end = count.cumsum(0)
    total = int(end[-1]) if len(end) else 0
    spacing = total / most if total > most else 1.0
    shift = u if total > most else 0.0
    number = ((torch.arange(min(total, most), dtype=torch.float64) + shift) * spacing).floor().clamp(max=total - 1)
    row = torch.searchsorted(end, number, right=True)
    return row, number - (end - count)[row], torch.full_like(number, spacing)
