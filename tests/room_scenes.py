"""Rooms in which light goes to and fro, for tests of bounces."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
_QUAD = torch.tensor([[0, 1, 2], [0, 2, 3]])


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def quad(*corners: tuple[float, float, float], **material: Any) -> eg.Mesh:
    return eg.Mesh(torch.tensor(corners, dtype=F64), _QUAD, material=eg.Material(**material))


def block(low: tuple[float, float, float], high: tuple[float, float, float], **material: Any) -> eg.Mesh:
    """A box between two corners."""
    ends = list(zip(low, high, strict=True))
    verts = torch.tensor([[x, y, z] for x in ends[0] for y in ends[1] for z in ends[2]], dtype=F64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads])
    return eg.Mesh(verts, faces, material=eg.Material(**material))


def lamp(side: float = 0.4, height: float = 1.9, power: float = 6.0) -> eg.Mesh:
    """Square, below the ceiling, that shines down."""
    s = side
    return quad((-s, -s, height), (-s, s, height), (s, s, height), (s, -s, height),
                base_color=0.0, emission=vector(power, 0.9 * power, 0.7 * power), two_sided=False)  # fmt: skip


def box_room(lights: str = "lamp", floor: dict[str, Any] | None = None, **of_block: Any) -> eg.Scene:
    """|x|, |y| < 1, 0 < z < 2, open towards −y, with walls in colours and a block inside."""
    white, red, green = vector(0.75, 0.75, 0.75), vector(0.7, 0.15, 0.1), vector(0.15, 0.6, 0.2)
    meshes = [
        quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), **(floor or {"base_color": white})),
        quad((-1, 1, 0), (1, 1, 0), (1, 1, 2), (-1, 1, 2), base_color=white),
        quad((-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2), base_color=red),
        quad((1, -1, 0), (1, -1, 2), (1, 1, 2), (1, 1, 0), base_color=green),
        block((-0.5, -0.2, 0.2), (0.1, 0.5, 0.9), **({"base_color": white} | of_block)),
    ]
    if lights != "sky":
        meshes.append(quad((-1, -1, 2), (-1, 1, 2), (1, 1, 2), (1, -1, 2), base_color=white))
    given: list[Any] = []
    if lights == "lamp":
        meshes.append(lamp())
    elif lights == "point":
        given.append(eg.PointLight(vector(0.5, -0.3, 1.7), 4.0))
    else:
        given.append(eg.Environment(vector(0.9, 1.0, 1.2)))
    return eg.Scene(meshes, lights=given)


def towards_room(size: int = 32) -> eg.Camera:
    return eg.Camera.look_at((0.0, -3.4, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), fov_y=38.0, size=(size, size))
