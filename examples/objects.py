"""Used by other examples: a painted stone that needs no file, and cameras around it."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

import edgegrad as eg


def pebble(texels: int = 256, subdivisions: int = 4) -> eg.Mesh:
    """A bumpy stone, some 2 units long, with a pattern of blotches; each face of a cube around it is a sixth of the texture."""
    cube = trimesh.creation.box().subdivide_loop(iterations=0)
    for _ in range(subdivisions):
        cube = cube.subdivide()
    p = 2.0 * torch.tensor(cube.vertices, dtype=torch.float64)  # on the faces of [-1, 1]³
    faces = torch.tensor(cube.faces)
    n = F.normalize(p, dim=1)
    waves = torch.tensor([[2.1, 0.3, 1.2], [-0.7, 2.6, 0.4], [0.9, -1.5, 2.3], [3.1, 1.9, -1.1]], dtype=torch.float64)
    bumps = torch.sin(n @ waves.T + torch.arange(4)).sum(1, keepdim=True)
    verts = n * (1.0 + 0.09 * bumps) * torch.tensor([1.0, 0.75, 0.85], dtype=torch.float64)

    corners = p[faces]  # (F, 3, 3): the axis along which all three lie at ±1 is the side of the cube
    same = (corners.mean(1).abs() > 1.0 - 1e-9).double()
    axis = same.argmax(1)
    side = 2 * axis + (corners.mean(1).gather(1, axis[:, None])[:, 0] > 0)
    across = torch.stack([(axis + 1) % 3, (axis + 2) % 3], 1)
    st = corners.gather(2, across[:, None].expand(-1, 3, -1)) * 0.49 * (1.0 - 8.0 / texels) + 0.5  # a gap between tiles
    tile = torch.stack([side % 3, side // 3], 1)[:, None]
    uvs = (st + tile) / torch.tensor([3.0, 2.0], dtype=torch.float64)
    return eg.Mesh(
        verts.float(), faces, texture=blotches(texels), uvs=uvs.reshape(-1, 2).float(),
        uv_faces=torch.arange(3 * len(faces)).reshape(-1, 3),
    )  # fmt: skip


def blotches(size: int, seed: int = 0) -> Tensor:
    """(size, size, 3) smooth noise of two scales, as radiance."""
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(1, 3, size, size)
    for cells, height in ((9, 0.7), (36, 0.3)):
        noise = torch.rand((1, 3, cells, cells), generator=generator)
        total += height * F.interpolate(noise, (size, size), mode="bicubic")
    return (1.6 * (total[0].movedim(0, -1) - 0.5) + 0.45).clamp(0.03, 0.95)


def around(mesh: eg.Mesh, count: int, size: int, distance: float = 1.5) -> list[eg.Camera]:
    """Cameras on a spiral around a mesh, so many diagonals of its box away."""
    low, high = mesh.verts.detach().double().aminmax(dim=0)
    middle, diagonal = (low + high) / 2, float((high - low).norm())
    cameras = []
    for k in range(count):
        y = 1.0 - (2 * k + 1) / count
        turn = k * math.pi * (3.0 - math.sqrt(5.0))
        r = math.sqrt(1.0 - y * y)
        direction = torch.tensor([r * math.cos(turn), y, r * math.sin(turn)], dtype=torch.float64)
        cameras.append(
            eg.Camera.look_at(middle + distance * diagonal * direction, middle, (0.1, 1.0, 0.2), 40.0, (size, size))
        )
    return cameras


def load(path: str | None) -> eg.Mesh:
    """A mesh file, or the stone."""
    return pebble() if path is None else eg.load_mesh(path)
