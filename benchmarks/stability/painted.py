"""Problems whose faces are painted by a shader, by nearest texels or by alpha, with exact integrals of what they are equal to."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.points.hits import Hits
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ..scenes import background, icosphere
from .cases.case import Problem, everything

F64 = torch.float64


def shaded_sphere(camera: Camera) -> Problem:
    """Return a sphere whose shader interpolates colours of vertices."""
    mesh = icosphere(2)
    colors = mesh.colors
    assert colors is not None
    problem = everything(Scene([mesh], background()), camera, colors=False)
    return dataclasses.replace(problem, options={"shader": lambda hits: hits.interpolate(colors)})


def _texels() -> Tensor:
    return torch.rand((4, 4, 3), generator=torch.Generator().manual_seed(0), dtype=F64)


def _floors(hits: Hits) -> Tensor:
    """Look texels up by floor()."""
    column, row = hits.floor(4 * torch.stack([hits.uv[:, 0], 1 - hits.uv[:, 1]], 1)).long().clamp(0, 3).unbind(1)
    return _texels()[row, column]


def board(camera: Camera, shader: Callable[[Hits], Tensor] | None = None, **look: Any) -> Problem:
    """Return a tilted square of 4 × 4 texels. It equals 16 squares, without those that alpha masks."""
    n = 4
    place = torch.cartesian_prod(*[torch.linspace(0, 1, n + 1, dtype=F64)] * 2)  # (25, 2), v and u of corners
    v, u = place.unbind(1)
    # Of the faces 0 1 2 (u ≥ v) and 0 2 3 both give the same on the diagonal.
    low, high = torch.minimum(u, v), torch.maximum(u, v)
    zero = torch.zeros_like(u)
    weights = torch.stack([1 - high, torch.where(u >= v, u - v, zero), low, torch.where(u >= v, zero, v - u)], 1)
    cell = torch.cartesian_prod(torch.arange(n), torch.arange(n))
    a = cell[:, 0] * (n + 1) + cell[:, 1]
    faces = torch.stack([a, a + 1, a + n + 2, a, a + n + 2, a + n + 1], 1)
    there = torch.ones(n * n, dtype=torch.bool)
    texels = _texels().flip(0).reshape(-1, 3)  # by rows of v, upwards
    if "alpha" in look:
        there = texels.mean(1) >= 0.5
        look["face_colors"] = torch.tensor([[0.2, 0.7, 0.4]], dtype=F64).expand(2, 3)
        texels = look["face_colors"][:1].expand(n * n, 3)
    faces, colors = faces[there].reshape(-1, 3), texels[there].repeat_interleave(2, 0)

    corner = torch.tensor([[-0.7, -0.6, 0.2], [0.8, -0.7, -0.3], [0.6, 0.7, 0.1], [-0.6, 0.8, -0.2]], dtype=F64)
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64)
    halves = torch.tensor([[0, 1, 2], [0, 2, 3]])
    bare = Mesh(corner, halves)

    def shown(scene: Scene) -> Scene:
        mesh = scene.meshes[0].replace(uvs=uvs, uv_faces=halves, wrap="clamp", **look)
        return scene.replace(meshes=[mesh])

    def equal(scene: Scene) -> Scene:
        return scene.replace(meshes=[Mesh(weights @ scene.meshes[0].verts, faces, face_colors=colors)])

    return everything(Scene([bare], background()), camera, shown, equal, options={"shader": shader})


PAINTED: dict[str, Callable[[Camera], Problem]] = {
    "sphere, shader": shaded_sphere,
    "floor of a shader": lambda camera: board(camera, shader=_floors),
    "nearest texels": lambda camera: board(camera, texture=_texels(), filter="nearest"),
    "cut out by alpha": lambda camera: board(camera, alpha=_texels().mean(-1), alpha_cutoff=0.5, filter="nearest"),
}
