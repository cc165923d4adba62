"""Alpha-tested faces, and textures whose nearest texel is taken, for tests."""

from __future__ import annotations

import torch
from torch import Tensor

import edgegrad as eg

F64 = torch.float64


def centres(n: int) -> Tensor:
    return (torch.arange(n, dtype=F64) + 0.5) / n


def disc(n: int = 33, radius: float = 0.35) -> Tensor:
    """(n, n) alpha, ½ on a circle around the middle."""
    x = centres(n) - 0.5
    return 0.5 + 2.0 * (radius - (x[None] ** 2 + x[:, None] ** 2).sqrt())


def quad(side: int = 1, **fields: object) -> eg.Mesh:
    """The square [−1, 1]² at z = 0 with texture coordinates from 0 to 1, as 2 · side² faces."""
    x = torch.linspace(-1.0, 1.0, side + 1, dtype=F64)
    verts = torch.stack([*torch.meshgrid(x, x, indexing="xy"), torch.zeros(side + 1, side + 1, dtype=F64)], -1)
    uvs = 0.5 * verts[..., :2] + 0.5
    i, j = (k.reshape(-1) for k in torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij"))
    a = i * (side + 1) + j
    faces = torch.cat([torch.stack([a, a + 1, a + side + 2], 1), torch.stack([a, a + side + 2, a + side + 1], 1)])
    return eg.Mesh(verts.reshape(-1, 3), faces, uvs=uvs.reshape(-1, 2), uv_faces=faces, **fields)  # type: ignore[arg-type]


def checkerboard(n: int, seed: int = 0) -> Tensor:
    """(n, n, 3), bright and dark in turn, of many colours."""
    tint = 0.3 * torch.rand((n, n, 3), generator=torch.Generator().manual_seed(seed), dtype=F64)
    dark = (torch.arange(n)[:, None] + torch.arange(n)) % 2
    return tint + 0.6 * dark[..., None]
