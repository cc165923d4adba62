"""Ten glossy scenes for the test of unbiasedness: light samples are chosen by what the surface reflects."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from edgegrad.sampling import Sampling
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import PointLight
from edgegrad.scene.material import Material, Texture
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import icosphere
from .camera import ORIGIN, vector
from .case import F64, Parts, Problem, View
from .light import LIGHT_AT, MakeLight, adjoint, panel, stage, torus, view

SIZE = 16
STILL = {
    "caster": vector(1.0, 0.3, 0.2)[None],
    "receiver": vector(0.1, 0.2, 1.0)[None],
    "camera": vector(1.0, 0.2, 0.3)[None],
}
MOVES = {**STILL, "light": vector(1.0, 0.3, 0.2)[None]}
MIRRORED = vector(-0.5, 1.5, 1.9)  # where the plane mirrors a light into the view
TEXELS = 4  # parts of a sky side by side whose brightness counts by itself
LIGHTS = ((4, 6, 20.0), (5, 21, 30.0), (8, 13, 10.0))  # row, column and radiance, two texels wide and high


def sky(small_lights: bool) -> MakeLight:
    """Return a smooth sky, with or without three small lights; the camera does not see it, which lowers the noise."""
    image = torch.linspace(1.0, 0.3, 16, dtype=F64)[:, None].repeat(1, 32)
    for row, column, radiance in LIGHTS if small_lights else ():
        image[row : row + 2, column : column + 2] = radiance

    def make_light(at: Tensor, level: Tensor) -> Environment:
        levels = level.expand(TEXELS).repeat_interleave(32 // TEXELS)
        return Environment((levels * image)[..., None], visible=False)

    return make_light


def bulb(at: Tensor, level: Tensor) -> Mesh:
    """Return a sphere that emits light."""
    shape = icosphere(1)
    return Mesh(shape.verts, shape.faces, material=Material(base_color=0.0, emission=12.0 * level)).transformed(
        scale=0.3, t=at
    )


def softbox(at: Tensor, level: Tensor) -> Mesh:
    """Return an area light as large as the lit objects."""
    corners = torch.tensor([[-1.5, -1, 0], [1.5, -1, 0], [1.5, 1, 0], [-1.5, 1, 0]], dtype=F64)
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]])  # downwards
    return Mesh(corners + at, faces, material=Material(base_color=0.0, emission=2.0 * level))


def point(at: Tensor, level: Tensor) -> PointLight:
    return PointLight(at, 10.0 * level)


def staged(make_light: MakeLight, roughness: float, metallic: float, **fields: Any) -> Problem:
    """Return a box over a plane. Steps are so short that the error of finite differences is below their noise."""
    of_sky = make_light(LIGHT_AT, torch.ones(1, dtype=F64))
    is_sky = isinstance(of_sky, Environment)
    problem = stage(
        make_light, MIRRORED, camera=view(size=SIZE), adjoint=adjoint(SIZE), moves=STILL if is_sky else MOVES, step=0.004,
        material={"roughness": roughness, "metallic": metallic}, **fields,
    )  # fmt: skip
    if is_sky:
        problem.parts["brightness"] = torch.ones(TEXELS, dtype=F64)
    return problem


def ball(make_light: MakeLight, roughness: float, metallic: float) -> Problem:
    """Return a ball over a plane; its normals are a part, too."""
    shape = icosphere(2).transformed(scale=0.5).transformed(t=vector(0.0, 0.0, 0.8))
    shape = Mesh(shape.verts, shape.faces, normals=shape.vertex_normals())
    problem = staged(make_light, roughness, metallic, caster=shape)
    made = problem.make

    def make(parts: Parts) -> View:
        scene, camera = made(parts)
        plane, caster = scene.meshes
        assert caster.normals is not None
        turned = caster.replace(normals=caster.normals + parts["normals"])
        return scene.replace(meshes=[plane, turned]), camera

    parts = {**problem.parts, "normals": torch.zeros(3, dtype=F64)}
    return dataclasses.replace(problem, parts=parts, make=make, equal=None, steps={**problem.steps, "normals": 0.01})


def veiled(make_light: MakeLight, roughness: float, metallic: float) -> Problem:
    """Return a sheet seen from behind, alpha-blended before a plane."""
    corners = torch.tensor([[-0.7, -0.6, 0.5], [0.8, -0.5, 0.6], [0.7, 0.6, 1.0], [-0.6, 0.5, 0.9]], dtype=F64)
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]])
    sheet = Mesh(corners, faces, uvs=corners[:, :2], uv_faces=faces)
    problem = staged(make_light, roughness, metallic, caster=sheet)
    made = problem.make

    def make(parts: Parts) -> View:
        scene, camera = made(parts)
        plane, caster = scene.meshes[:2]
        assert caster.material is not None
        look = dataclasses.replace(caster.material, alpha_mode="BLEND")
        alpha = parts["alpha"].expand(2, 2)
        return scene.replace(meshes=[plane, caster.replace(material=look, alpha=alpha), *scene.meshes[2:]]), camera

    parts = {**problem.parts, "alpha": vector(0.4)}
    return dataclasses.replace(problem, parts=parts, make=make, equal=None, steps={**problem.steps, "alpha": 0.01})


def mapped(make_light: MakeLight, roughness: float, metallic: float, filter: str = "linear") -> Problem:
    """Return a plane with a wavy normal map and textures of roughness and base colour; texture coordinates are a part, too.
    With mipmaps, the textures repeat until a pixel holds several texels."""
    repeats = 4.0 if filter == "mipmap" else 1.0
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
        "brightness": torch.ones(TEXELS, dtype=F64),
    }

    def make(parts: Parts) -> View:
        uvs = repeats * (corners / 2 + 0.5) + parts["texture coordinates"]
        look = Material(
            base_color=Texture(waves * vector(0.9, 0.7, 0.5), filter=filter),
            metallic=parts["metallic"],
            roughness=Texture(2 * waves * parts["roughness"], filter=filter),
            normal_map=Texture(normals, filter=filter),
        )
        verts = torch.cat([1.5 * corners, torch.zeros(4, 1, dtype=F64)], 1) + parts["shift"] * vector(0.2, 0.3, 1.0)
        plane = Mesh(verts, faces, uvs=uvs, uv_faces=faces, material=look)
        return Scene([plane], lights=[make_light(LIGHT_AT, parts["brightness"])]), view(target=ORIGIN, size=SIZE)

    steps = {
        "shift": 0.004, "texture coordinates": 0.002, "roughness": 0.005 * roughness, "metallic": 0.01, "brightness": 0.1,
    }  # fmt: skip
    # Mipmaps are made for the pixels that there are: finer ones would show other levels.
    finer = 1 if filter == "mipmap" else 16
    return Problem(
        parts, make, None, "finite differences", steps=steps, finer=finer, adjoint=adjoint(SIZE),
        options={"sampling": Sampling(lights=4)},
    )  # fmt: skip


GLOSSY: dict[str, Callable[[], Problem]] = {
    "glossy, metal ball of roughness 0.25, smooth sky": partial(ball, sky(False), 0.25, 0.95),
    "glossy, plastic of roughness 0.15, sky with small lights": partial(staged, sky(True), 0.15, 0.05),
    "glossy, metal of roughness 0.1, sky with small lights": partial(staged, sky(True), 0.1, 0.95),
    "glossy, metal torus of roughness 0.4, quad that emits": partial(staged, panel(), 0.4, 0.95, caster=torus()),
    "glossy, metal of roughness 0.3, ball that emits": partial(staged, bulb, 0.3, 0.95),
    "glossy, metal of roughness 0.2, softbox": partial(staged, softbox, 0.2, 0.95),
    "glossy, plastic of roughness 0.3, point light": partial(staged, point, 0.3, 0.05),
    "glossy, normal map, smooth sky": partial(mapped, sky(False), 0.25, 0.7),
    "glossy, mipmaps, sky with small lights": partial(mapped, sky(True), 0.3, 0.7, filter="mipmap"),
    "glossy, sheet that blends, seen from behind, quad that emits": partial(veiled, panel(), 0.25, 0.5),
}
