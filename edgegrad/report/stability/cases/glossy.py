"""Glossy surfaces under skies and lamps, for the test of unbiasedness: light that is drawn by what it meets."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ....scene.environment import Environment
from ....scene.material import Material, Texture, vertex_normals
from ....scene.mesh import Mesh
from ....scene.scene import Scene
from ...scenes import sphere
from .camera import ORIGIN, vector
from .case import F64, Parts, Problem, View
from .light import LAMP, Lamp, adjoint, panel, stage, torus, view

SIZE = 16
MOVES = {
    "caster": vector(1.0, 0.3, 0.2)[None],
    "receiver": vector(0.1, 0.2, 1.0)[None],
    "camera": vector(1.0, 0.2, 0.3)[None],
}


def sky(lamps: bool) -> Lamp:
    """A gradient, or one with three lamps."""
    image = torch.linspace(1.0, 0.3, 16, dtype=F64)[:, None, None].repeat(1, 32, 1)
    for row, column, radiance in ((4, 6, 20.0), (5, 21, 30.0), (8, 13, 10.0)) if lamps else ():
        image[row : row + 2, column : column + 2] = radiance
    return lambda at, level: Environment(level * image, visible=False)


def bulb(at: Tensor, level: Tensor) -> Mesh:
    """A sphere that emits."""
    shape = sphere(1)
    return Mesh(shape.verts, shape.faces, material=Material(base_color=0.0, emission=12.0 * level)).transformed(
        scale=0.3, t=at
    )


def staged(lamp: Lamp, roughness: float, metallic: float, **fields: Any) -> Problem:
    # By steps so short that what the differences are off by themselves is below their noise.
    return stage(
        lamp, camera=view(size=SIZE), adjoint=adjoint(SIZE), moves=MOVES, step=0.004,
        material={"roughness": roughness, "metallic": metallic}, **fields,
    )  # fmt: skip


def _ball() -> Mesh:
    ball = sphere(2).transformed(scale=0.5).transformed(t=vector(0.0, 0.0, 0.8))
    return Mesh(ball.verts, ball.faces, normals=vertex_normals(ball.verts, ball.faces))


def mapped(lamp: Lamp, roughness: float, metallic: float) -> Problem:
    """A plane with waves in its normal map, and textures of roughness and base colour; the texture coordinates move too."""
    corners = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    y, x = torch.meshgrid(torch.arange(16, dtype=F64), torch.arange(16, dtype=F64), indexing="ij")
    tilt = torch.stack([0.25 * torch.sin(math.pi * x / 4), 0.25 * torch.sin(math.pi * y / 8), torch.ones_like(x)], -1)
    normals = torch.nn.functional.normalize(tilt, dim=-1) / 2 + 0.5
    waves = 0.5 + 0.3 * torch.sin(math.pi * (x + y) / 8)[..., None]
    parts: Parts = {
        "shift": torch.zeros(1, dtype=F64),
        "texture coordinates": torch.zeros(2, dtype=F64),
        "roughness": vector(roughness),
        "metallic": vector(metallic),
        "brightness": vector(1.0),
    }

    def make(parts: Parts) -> View:
        uvs = corners / 2 + 0.5 + parts["texture coordinates"]
        look = Material(
            base_color=Texture(waves * vector(0.9, 0.7, 0.5)),
            metallic=parts["metallic"],
            roughness=Texture(2 * waves * parts["roughness"]),
            normal_map=Texture(normals),
        )
        verts = torch.cat([1.5 * corners, torch.zeros(4, 1, dtype=F64)], 1) + parts["shift"] * vector(0.2, 0.3, 1.0)
        plane = Mesh(verts, faces, uvs=uvs, uv_faces=faces, material=look)
        return Scene([plane], lights=[lamp(LAMP, parts["brightness"])]), view(target=ORIGIN, size=SIZE)

    steps = {
        "shift": 0.004, "texture coordinates": 0.002, "roughness": 0.005 * roughness, "metallic": 0.01, "brightness": 0.1,
    }  # fmt: skip
    return Problem(
        parts, make, None, "finite differences", steps=steps, finer=16, adjoint=adjoint(SIZE), options={"light_samples": 4}
    )  # fmt: skip


GLOSSY: dict[str, Callable[[], Problem]] = {
    "glossy, metal of roughness 0.5, sky": partial(staged, sky(False), 0.5, 0.95),
    "glossy, metal of roughness 0.2, sky": partial(staged, sky(False), 0.2, 0.95),
    "glossy, metal of roughness 0.3, sky with lamps": partial(staged, sky(True), 0.3, 0.95),
    "glossy, plastic of roughness 0.15, sky with lamps": partial(staged, sky(True), 0.15, 0.05),
    "glossy, plastic of roughness 0.9, sky with lamps": partial(staged, sky(True), 0.9, 0.05),
    "glossy, metal ball of roughness 0.25, sky": partial(staged, sky(False), 0.25, 0.95, caster=_ball()),
    "glossy, metal torus of roughness 0.4, panel": partial(staged, panel(), 0.4, 0.95, caster=torus()),
    "glossy, plastic of roughness 0.2, panel": partial(staged, panel(), 0.2, 0.05),
    "glossy, metal of roughness 0.3, sphere that emits": partial(staged, bulb, 0.3, 0.95),
    "glossy, normal map, sky": partial(mapped, sky(False), 0.25, 0.7),
}
