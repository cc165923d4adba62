"""Means of pixels over what the triangles cover of them, with the derivative of these means.

In normalized device coordinates (x, y, z)/w the image is an orthographic one along z, and triangles are triangles: those that
reach through the near or far plane are cut there. So edgegrad's samples of pixels and of edges serve as they are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..points.hits import Hits
from ..points.samples import attach_boundary, edge_samples, primary_hits
from ..scene.mesh import Mesh


def exact_means(color: Tensor, rast: Tensor, pos: Tensor, tri: Tensor, spp: int, seed: int) -> Tensor:
    """Return the means (H, W, C) of one image: color (H, W, C), rast (H, W, 4), pos (V, 4), tri (F, 3). Triangles are counted
    as in rast."""
    height, width = color.shape[:2]
    shown = PixelColors(color.reshape(height * width, -1), rast.detach().reshape(-1, 4), (height, width))
    mesh, owner = _in_device_coordinates(pos.double(), tri)
    background = shown.background()
    if mesh is None:
        return background.view_as(color)
    K = torch.tensor([[width / 2, 0, width / 2], [0, height / 2, height / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, (height, width), "orthographic")
    primary = primary_hits(mesh, camera, spp, seed)
    behind = background.view(height, width, -1).double()
    image = primary.image(shown.of_hits(primary.hits, owner).double(), behind)
    if pos.requires_grad and torch.is_grad_enabled():
        edges = edge_samples(primary)
        with torch.no_grad():
            jump = edges.jump(shown.of_hits(edges.hits, owner).double())
        image = attach_boundary(image, edges, jump, behind.detach())
    return image.to(color.dtype)


class PixelColors(NamedTuple):
    """Colours at the centres of an image's pixels, from which samples take theirs."""

    color: Tensor  # (H W, C)
    rast: Tensor  # (H W, 4)
    size: tuple[int, int]

    def of_hits(self, hits: Hits, owner: Tensor) -> Tensor:
        """Return colours (N, C) of samples: of the pixel, among the nine around a sample, that shows its triangle, or else of
        one anywhere. If none does, it is that of the one of the nine that shows the surface nearest in depth; if none shows
        any, of the sample's own pixel."""
        height, width = self.size
        column, row = hits.pixel.detach().floor().long().unbind(1)
        row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)  # of a sample on the image's border
        own, face = row * width + column, owner[hits.face]
        lost = (self.rast[:, 3].long()[own] != face + 1).nonzero()[:, 0]
        if len(lost):
            number = 1 + int(owner.max())
            own[lost] = self._around(row[lost], column[lost], face[lost], hits.depth.detach()[lost], number)
        return self.color[own]

    def _around(self, row: Tensor, column: Tensor, face: Tensor, depth: Tensor, triangles: int) -> Tensor:
        """Return the pixels (N,) that samples take their colours of, if it need not be their own."""
        height, width = self.size
        own = row * width + column
        anywhere = self._pixel_of(triangles)[face]
        best = torch.where(anywhere >= 0, -1.0, torch.inf)
        source = torch.where(anywhere >= 0, anywhere, own)
        for dy, dx in sorted(
            ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)), key=lambda step: step[0] ** 2 + step[1] ** 2
        ):
            y, x = row + dy, column + dx
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            at = torch.where(inside, y * width + x, own)
            triangle, z = self.rast[at, 3].long() - 1, self.rast[at, 2].double()
            cost = torch.where(triangle == face, -2.0, (z - depth).abs())
            better = inside & (triangle >= 0) & (cost < best)
            best, source = torch.where(better, cost, best), torch.where(better, at, source)
        return source

    def _pixel_of(self, triangles: int) -> Tensor:
        """Return a pixel (F,) that shows each triangle, or −1."""
        pixels = torch.arange(len(self.rast))
        found = torch.full((triangles + 1,), -1).scatter_reduce(0, self.rast[:, 3].long(), pixels, "amax")
        return found[1:]

    def background(self) -> Tensor:
        """Return (H W, C) what the nearest pixel without a triangle shows, by steps to neighbours; black if there is none."""
        height, width = self.size
        empty = self.rast[:, 3] == 0
        if not bool(empty.any()):
            return torch.zeros_like(self.color)
        source = torch.where(empty, torch.arange(height * width), -1).view(height, width)
        while bool((source < 0).any()):
            known = torch.nn.functional.pad(source, (1, 1, 1, 1), value=-1)
            for dy, dx in ((0, 1), (2, 1), (1, 0), (1, 2)):
                near = known[dy : dy + height, dx : dx + width]
                source = torch.where(source < 0, near, source)
        return self.color[source.reshape(-1)]


def _in_device_coordinates(pos: Tensor, tri: Tensor) -> tuple[Mesh | None, Tensor]:
    """Return the parts of triangles between the near and the far plane, None without any, and the triangle of each face."""
    owner = torch.arange(len(tri))
    tri = tri.long()
    for plane in ((0.0, 0.0, 1.0, 1.0), (0.0, 0.0, -1.0, 1.0)):
        pos, tri, owner = _cut(pos, tri, owner, pos @ pos.new_tensor(plane))
    before = (pos.detach()[tri][..., 3] > 0).all(1)
    used, faces = tri[before].unique(return_inverse=True)
    if len(used) == 0:
        return None, owner
    kept = pos[used]
    return Mesh(kept[:, :3] / kept[:, 3:], faces.reshape(-1, 3)), owner[before]


def _cut(pos: Tensor, tri: Tensor, owner: Tensor, height: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the part of triangles where the height (V,), linear on them, is not below zero."""
    inside = height.detach() >= 0
    count = inside[tri].sum(1)
    crossing = (count == 1) | (count == 2)
    if not bool(crossing.any()):
        return pos, tri[count == 3], owner[count == 3]
    corners, one = tri[crossing], count[crossing] == 1
    # The corner that is alone on its side comes first.
    alone = (inside[corners] == one[:, None]).int().argmax(1)
    a, b, c = ((corners.gather(1, (alone[:, None] + k) % 3))[:, 0] for k in range(3))
    ends, index = torch.stack([torch.stack([a, a]), torch.stack([b, c])], 2).reshape(-1, 2).sort(1).values.unique(
        dim=0, return_inverse=True
    )  # fmt: skip
    p, q = ends.unbind(1)
    along = (height[p] / (height[p] - height[q]))[:, None]
    ab, ac = (index + len(pos)).view(2, -1)
    pos = torch.cat([pos, pos[p] + along * (pos[q] - pos[p])])
    parts = [
        tri[count == 3],
        torch.stack([a, ab, ac], 1)[one],
        torch.stack([ab, b, c], 1)[~one],
        torch.stack([ab, c, ac], 1)[~one],
    ]
    own = owner[crossing]
    return pos, torch.cat(parts), torch.cat([owner[count == 3], own[one], own[~one], own[~one]])
