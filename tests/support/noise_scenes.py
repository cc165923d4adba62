"""Small scenes of each kind, with a tensor whose gradient has noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from bounce_scenes import QUAD, block, cornell, leaf, mesh, texels
from room_scenes import F64
from scenes import smooth_adjoint
from torch import Tensor

import edgegrad as eg
from edgegrad.scene.lights import Light


class NoiseScene(NamedTuple):
    """What is rendered, and what of it requires a gradient."""

    scene: eg.Scene
    camera: eg.Camera
    leaf: Tensor
    options: dict[str, Any]
    seeds: int = 12  # that decide whether noise falls

    def render(self, spp: int, seed: int) -> Tensor:
        return eg.render(self.scene, self.camera, spp, seed, **self.options)

    @staticmethod
    def loss(image: Tensor) -> Tensor:
        adjoint = smooth_adjoint(*image.shape[-3:]).to(image)
        return (adjoint * image).sum()


def camera(size: int = 16) -> eg.Camera:
    return eg.Camera.look_at((1.2, 1.4, 3.4), (0, 0, 0), (0.0, 1.0, 0.01), 35.0, (size, size)).to(F64)


def moving(own: eg.Mesh, others: list[eg.Mesh], lights: tuple[Light, ...] = (), **options: Any) -> NoiseScene:
    """Return a scene of which the vertices of the first mesh require a gradient."""
    verts = own.verts.clone().requires_grad_()
    scene = eg.Scene([own.replace(verts=verts), *others], lights=list(lights))
    return NoiseScene(scene, camera(), verts, options)


def coloured_block() -> eg.Mesh:
    own = block((0.0, 0.0, 0.0), (0.6, 0.6, 0.6), 0.3, 0.1)
    return own.replace(face_colors=None, material=None, colors=0.5 + 0.4 * torch.sin(3 * own.verts))


def ground() -> eg.Mesh:
    return mesh([[-3, -0.9, -3], [-3, -0.9, 3], [3, -0.9, 3], [3, -0.9, -3]], QUAD, 0.7)


def point_light() -> Light:
    return eg.lights.PointLight(torch.tensor([1.5, 3.0, 1.0], dtype=F64), torch.tensor([30.0], dtype=F64))


def panel() -> eg.Mesh:
    return mesh([[1, 2.5, 0.5], [2, 2.5, 0.5], [2, 2.5, 1.5], [1, 2.5, 1.5]], QUAD, 0.0, 20.0)


def smooth_shader(hits: eg.points.Hits) -> Tensor:
    x = hits.position
    return (torch.sin(3 * x[:, :1]) * torch.cos(2 * x[:, 1:2]) + 1.5) * (0.3 + hits.normal[:, 2:3].abs())


def stripes(hits: eg.points.Hits) -> Tensor:
    x = hits.position
    return hits.where(torch.sin(5 * x[:, :1] + 2 * x[:, 1:2]), x.new_tensor([[1.0]]), x.new_tensor([[0.2]]))


def shaded_sheet() -> NoiseScene:
    """A sheet with a hole of alpha, under a light."""
    own = leaf().meshes["leaf"]
    return moving(own.replace(verts=1.4 * own.verts), [ground()], (point_light(),))


def bouncing(scene: Any, name: str, size: int = 8) -> NoiseScene:
    """Return a room of which one mesh moves as a whole, with light that is scattered twice."""
    shift = torch.zeros(3, dtype=F64, requires_grad=True)
    own = scene.meshes[name]
    meshes = scene.meshes | {name: own.replace(verts=own.verts + shift)}
    small = scene.camera.resized((size, size))
    return NoiseScene(eg.Scene(list(meshes.values())), small, shift, {"bounces": 2})


NOISE_SCENES: dict[str, Callable[[], NoiseScene]] = {
    "faces": lambda: moving(coloured_block(), []),
    "point light": lambda: moving(block((0, 0, 0), (0.6, 0.6, 0.6), 0.3, 0.1), [ground()], (point_light(),)),
    "area light": lambda: moving(block((0, 0, 0), (0.6, 0.6, 0.6), 0.3, 0.1), [ground(), panel()]),
    "alpha edges": shaded_sheet,
    "shader": lambda: moving(coloured_block(), [], shader=smooth_shader),
    "declared discontinuities": lambda: moving(coloured_block(), [], shader=stripes)._replace(seeds=24),
    "bounces": lambda: bouncing(cornell(), "block"),
    "bounces, alpha edges": lambda: bouncing(leaf(), "leaf"),
    "bounces, texel edges": lambda: bouncing(texels(), "block", 16),
}
