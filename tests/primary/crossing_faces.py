"""Faces that pass through each other, and what the kernel finds of them."""

from __future__ import annotations

import torch
from kernel_parts import parts
from scenes import icosphere
from torch import Tensor

import edgegrad as eg

F64 = torch.float64


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def joined(*meshes: eg.Mesh) -> tuple[Tensor, Tensor]:
    """Vertices and faces of all."""
    first = [sum(len(mesh.verts) for mesh in meshes[:k]) for k in range(len(meshes))]
    return torch.cat([m.verts for m in meshes]), torch.cat([m.faces + k for m, k in zip(meshes, first, strict=True)])


def found(verts: Tensor, faces: Tensor, *, threads: int = 1, windings: Tensor | None = None, share=None, seed: int = 0):
    """(face, face, end, end) of each; for how many each stands; and whether they are drawn, by the share (F,) of each face."""
    windings = faces if windings is None else windings
    share = torch.ones(len(faces)) if share is None else share
    arrays = verts.double().numpy(), faces.int().numpy(), windings.int().numpy()
    spacing = torch.finfo(verts.dtype).eps
    pairs, drawn = parts.intersections(*arrays, spacing, share.numpy(), seed, threads)
    return [pair[:4] for pair in pairs], torch.tensor([pair[4] for pair in pairs], dtype=F64), drawn


def random_triangles(n: int, seed: int, size: float = 1.0) -> tuple[Tensor, Tensor]:
    middle = torch.rand((n, 1, 3), generator=generator(seed), dtype=F64)
    verts = middle + size * (torch.rand((n, 3, 3), generator=generator(seed + 1), dtype=F64) - 0.5)
    return verts.reshape(-1, 3), torch.arange(3 * n).reshape(n, 3)


def tangle() -> tuple[Tensor, Tensor]:
    ball = icosphere(2)
    return ball.verts + 0.16 * torch.randn(ball.verts.shape, generator=generator(), dtype=F64), ball.faces
