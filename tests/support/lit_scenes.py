"""Planes and balls in the light, that the tests of lights and materials share, in float64."""

from __future__ import annotations

import math
from typing import Any

import torch
from finite_differences import Case
from oracles.shading import radiance
from scenes import icosphere, smooth_adjoint
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
QUAD = torch.tensor([[-0.5, -0.4, 1.0], [0.6, -0.5, 1.2], [0.7, 0.5, 1.3], [-0.3, 0.6, 0.9]], dtype=F64)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def uniform(count: int, seed: int = 0) -> Tensor:
    """(count, 3)"""
    return torch.rand((count, 3), dtype=F64, generator=torch.Generator().manual_seed(seed))


def picture(h: int = 4, w: int = 6, seed: int = 1) -> Tensor:
    """(h, w, 3) noise, nowhere black."""
    return 0.2 + torch.rand((h, w, 3), dtype=F64, generator=torch.Generator().manual_seed(seed))


def plane(size: float = 4.0, **fields: Any) -> eg.Mesh:
    """z = 0, seen from +z."""
    verts = size * torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return eg.Mesh(verts, faces, uvs=verts[:, :2] / (2 * size) + 0.5, uv_faces=faces, **fields)


def ball(level: int = 2, smooth: bool = True, **fields: Any) -> eg.Mesh:
    mesh = icosphere(level)
    mesh = eg.Mesh(mesh.verts, mesh.faces, **fields)
    return mesh.replace(normals=mesh.vertex_normals()) if smooth else mesh


def from_above(size: int = 16, width: float = 2.0) -> eg.Camera:
    """Orthographic, along −z: the square |x|, |y| < width / 2, x to the right and y up."""
    k = size / width
    K = torch.tensor([[k, 0, size / 2], [0, k, size / 2], [0, 0, 1]], dtype=F64)
    w2c = torch.tensor([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 5], [0, 0, 0, 1]], dtype=F64)
    return eg.Camera(w2c, K, (size, size), "orthographic")


def grid(size: int = 16, width: float = 2.0, fine: int = 8) -> Tensor:
    """(size, size, fine², 3): points of z = 0 in each pixel of from_above()."""
    t = (torch.arange(size * fine, dtype=F64) + 0.5) / (size * fine) * width - width / 2
    y, x = torch.meshgrid(-t, t, indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(size, fine, size, fine, 3)
    return points.permute(0, 2, 1, 3, 4).reshape(size, size, fine * fine, 3)


def hits_of(scene: eg.Scene, count: int = 1, place: Tensor | None = None, view: Tensor | None = None) -> eg.points.Hits:
    """`count` times the point of the scene that a ray from `view` to `place` meets."""
    target = vector(0, 0, 0) if place is None else place
    view = vector(0, 0, 1) if view is None else view
    origins = (target + 3 * view).expand(count, 3)
    return eg.points.trace(scene, origins, (-view).expand(count, 3))


def directions(n: int) -> tuple[Tensor, float]:
    """(M, 3) unit directions z > 0, each for the same solid angle, and that: products of midpoint rules in φ and cos θ."""
    t = (torch.arange(n, dtype=F64) + 0.5) / n
    z, phi = torch.meshgrid(t, 2 * math.pi * t, indexing="ij")
    r = (1 - z * z).sqrt()
    return torch.stack([r * phi.cos(), r * phi.sin(), z], -1).reshape(-1, 3), 2 * math.pi / n**2


def polygon_irradiance(corners: Tensor, place: Tensor, normal: Tensor) -> Tensor:
    """Irradiance over radiance at a place from a polygon (n, 3) above it, in closed form (Lambert 1760)."""
    v = torch.nn.functional.normalize(corners - place, dim=1)
    w = v.roll(-1, 0)
    cross = torch.linalg.cross(v, w)
    angle = torch.atan2(cross.norm(dim=1), (v * w).sum(1))
    return ((angle / cross.norm(dim=1))[:, None] * cross).sum(0) @ normal / 2


def by_quadrature(case: Case, step: float, fine: int = 8, **options: Any) -> float:
    """Central difference of the loss of finite_differences.py, of images by a regular grid of fine² rays a pixel, seen by
    from_above()."""

    def loss(theta: float) -> Tensor:
        scene, camera = case(torch.tensor(theta, dtype=F64))
        size = camera.size[0]
        places = grid(size, size / float(camera.K[0, 0]), fine).reshape(-1, 3) + vector(0, 0, 5)
        hits = eg.points.trace(scene, places, vector(0, 0, -1))
        values = torch.zeros((len(places), 3), dtype=F64).index_copy(0, hits.ray, radiance(hits, **options))
        image = values.reshape(size, size, fine * fine, 3).mean(2)
        return (image * smooth_adjoint(size, size, 3)).sum()

    with torch.no_grad():
        return ((loss(step) - loss(-step)) / (2 * step)).item()
