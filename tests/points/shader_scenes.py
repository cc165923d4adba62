"""Scenes that shaders of the tests shade."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.utils.checkpoint
from scenes import front_camera, icosphere, smooth_colors
from torch import Tensor

import edgegrad as eg

F64 = torch.float64


SIZE = 24


def colored(filter: str = "box") -> tuple[eg.Scene, eg.Camera]:
    ball = icosphere(2)
    ball = ball.replace(verts=0.9 * ball.verts, colors=smooth_colors(ball.verts))
    return eg.Scene([ball], torch.tensor([0.2, 0.5, 0.3], dtype=F64)), front_camera(SIZE)


def cameras() -> dict[str, eg.Camera]:
    straight = front_camera(SIZE)
    w, K = straight.world_to_camera, straight.K
    flat = K.clone()
    flat[:2, :2] /= 3.0
    return {
        "perspective": straight,
        "orthographic": eg.Camera(w, flat, (SIZE, SIZE), "orthographic"),
        "distorted": straight.replace(distortion=torch.tensor([-0.4, 0.3, 0.02, -0.01], dtype=F64)),
    }


def by_hand(scene: eg.Scene) -> Callable[[eg.points.Hits], Tensor]:
    mesh = scene.meshes[0]
    if mesh.texture is not None:
        texture = mesh.texture
        return lambda hits: hits.sample(texture)
    colors = mesh.colors
    assert colors is not None
    return lambda hits: hits.interpolate(colors)


def textured() -> eg.Scene:
    ball = icosphere(2)
    uvs = 0.25 * ball.verts[:, :2] + 0.5
    texture = torch.rand((4, 4, 3), generator=torch.Generator().manual_seed(1), dtype=F64)
    return eg.Scene([eg.Mesh(0.9 * ball.verts, ball.faces, texture=texture, uvs=uvs, uv_faces=ball.faces)])


def bumpy() -> eg.Mesh:
    ball = icosphere(3)
    return ball.replace(
        verts=ball.verts * (0.8 + 0.12 * torch.sin(5 * ball.verts[:, :1]) * torch.cos(4 * ball.verts[:, 1:2]))
    )


def network(width: int) -> torch.nn.Module:
    torch.manual_seed(3)
    layers = [torch.nn.Linear(width, 16), torch.nn.Tanh(), torch.nn.Linear(16, 3), torch.nn.Sigmoid()]
    return torch.nn.Sequential(*layers).double()
