"""Objects and photographs of which cases are drawn: made here, of installed packages, or files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from brackets import bracket
from objects import blotches, pebble
from torch import Tensor

import edgegrad as eg
from edgegrad.files.image import srgb_to_linear

Item = TypeVar("Item")
STONE_AXES = torch.tensor([1.0, 0.75, 0.85])  # Half the axes of the stone of the examples, before its bumps.
REPORTED = 1000  # The first seed to report on; those below are for tuning and training.
# Photographs of packages that tests need: scikit-image, Matplotlib, and the surroundings of viser.
PACKAGES = {
    "skimage": [f"data/{name}" for name in (
        "coffee.png", "astronaut.png", "chelsea.png", "rocket.jpg", "motorcycle_left.png", "gravel.png", "brick.png",
        "grass.png", "retina.jpg", "ihc.png",
    )],
    "matplotlib": ["mpl-data/sample_data/grace_hopper.jpg"],
    "viser": [f"_assets/hdri/{name}_1k.jpg" for name in (
        "forest_slope", "lebombo", "potsdamer_platz", "venice_sunset", "rooitou_park", "empty_warehouse_01", "kiara_1_dawn",
    )],
}  # fmt: skip


@dataclass(frozen=True)
class Sources:
    """Names of objects and files of photographs. Seeds for tuning and seeds to report on each have every other one of both."""

    meshes: tuple[str, ...] = ()  # names of OBJECTS, FILE, or FILE,TEXTURE; empty: all objects made here
    backgrounds: tuple[str, ...] = ()  # empty: those of packages, or boards where there are none

    def names(self, seed: int) -> Sequence[str]:
        """Return the objects that a seed may have."""
        return _half(self.meshes or tuple(OBJECTS), seed)

    def mesh(self, name: str, seed: int, rng: np.random.Generator) -> eg.Mesh:
        """Return an object with colours, centred, 1.8 units large."""
        mesh = OBJECTS[name](rng, self.photographs(seed)) if name in OBJECTS else from_file(name)
        if mesh.channels is None:
            mesh = mesh.replace(colors=_waves(mesh.verts, rng))
        low, high = mesh.verts.aminmax(dim=0)
        return mesh.replace(verts=(mesh.verts - (low + high) / 2) / (high - low).norm() * 1.8, material=None)

    def photographs(self, seed: int) -> Sequence[Tensor]:
        """Return the photographs (H, W, 3) that a seed may have, linear."""
        return _half(_photographs(self.backgrounds), seed)


def _half(items: Sequence[Item], seed: int) -> Sequence[Item]:
    return items[int(seed >= REPORTED) :: 2] or items


@cache
def _photographs(files: tuple[str, ...]) -> list[Tensor]:
    if not files:
        found = {name: find_spec(name) for name in PACKAGES}
        folders = {name: Path(spec.origin).parent for name, spec in found.items() if spec and spec.origin}
        files = tuple(str(folder / file) for name, folder in folders.items() for file in PACKAGES[name])
        files = tuple(file for file in files if Path(file).exists())
    return [eg.read_image(file, channels=3) for file in files] or [clutter(seed) for seed in range(8)]


@cache
def from_file(given: str) -> eg.Mesh:
    """Return the mesh of a FILE, or of FILE,TEXTURE. One that has no normals is smooth."""
    file, _, texture = given.partition(",")
    mesh = textured(Path(file), Path(texture)) if texture else eg.load_mesh(file)
    return mesh if mesh.normals is not None else mesh.replace(normals=mesh.vertex_normals())


def textured(mesh: Path, texture: Path) -> eg.Mesh:
    """Return the mesh with a texture that its file does not name."""
    return eg.load_mesh(mesh, materials=False).replace(texture=eg.read_image(texture, channels=3))


def clutter(seed: int, size: int = 320) -> Tensor:
    """Return an image (size, size, 3), linear, of boards of many sizes and colours on one another, each with its pattern."""
    rng = np.random.default_rng(seed)
    x = (np.arange(size) + 0.5) / size
    image = np.ones((size, size, 3)) * rng.uniform(0.2, 0.7, 3)
    for k in range(60):
        middle, angle = rng.uniform(0.0, 1.0, 2), rng.uniform(0.0, math.pi)
        half = rng.uniform(0.03, 0.45, 2) * (1.0 - k / 90)
        u = (x[None] - middle[0]) * math.cos(angle) + (x[:, None] - middle[1]) * math.sin(angle)
        v = -(x[None] - middle[0]) * math.sin(angle) + (x[:, None] - middle[1]) * math.cos(angle)
        waves = np.sin(2.0 * math.pi * rng.uniform(2.0, 25.0) * u + 3.0 * np.sin(rng.uniform(0.0, 15.0) * v))
        color = rng.uniform(0.05, 0.9, 3) * (1.0 + rng.uniform(0.0, 0.35) * waves[..., None])
        inside = (abs(u) < half[0]) & (abs(v) < half[1])
        image = np.where(inside[..., None], color * (1.0 + 0.5 * rng.uniform(-1.0, 1.0) * u[..., None]), image)
    return srgb_to_linear(torch.from_numpy(image).float().clamp(0.0, 1.0))


def crop(photograph: Tensor, size: tuple[int, int], rng: np.random.Generator, least: float = 1.0) -> Tensor:
    """Return a part of a photograph at a random place, as (*size, 3): the largest one, or down to a share of its sides."""
    H, W = photograph.shape[:2]
    scale = min(H / size[0], W / size[1]) * rng.uniform(least, 1.0)
    h, w = max(1, round(scale * size[0])), max(1, round(scale * size[1]))
    top, left = rng.integers(0, H - h + 1), rng.integers(0, W - w + 1)
    part = photograph[top : top + h, left : left + w].movedim(-1, 0)[None]
    return F.interpolate(part, size=size, mode="area")[0].movedim(0, -1).contiguous()


def _print(photographs: Sequence[Tensor], size: tuple[int, int], rng: np.random.Generator) -> Tensor:
    """Return a texture (*size, 3): a part of a photograph in another tint."""
    part = crop(photographs[int(rng.integers(len(photographs)))], size, rng, 0.5)
    return (part * torch.from_numpy(rng.uniform(0.5, 1.2, 3)).float() + 0.03).clamp(0.0, 0.95)


def _waves(verts: Tensor, rng: np.random.Generator) -> Tensor:
    """Return colours (V, 3) that vary smoothly in space, some five times across."""
    phases = 16.0 * verts / (verts.amax(0) - verts.amin(0)).norm() @ torch.from_numpy(rng.normal(size=(3, 6))).float()
    return 0.45 + 0.25 * torch.sin(phases).reshape(-1, 2, 3).sum(1).clamp(-1.6, 1.6)


def _stone(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    return _smooth(pebble().replace(texture=blotches(256, int(rng.integers(1 << 30)))))


def _carton(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    """Return a box with a print on each side."""
    mesh = pebble()
    n = mesh.verts / STONE_AXES
    sides = [_print(photographs, (128, 128), rng) for _ in range(6)]
    atlas = torch.cat([torch.cat(sides[:3], 1), torch.cat(sides[3:], 1)])
    half = torch.from_numpy(rng.uniform([0.7, 0.45, 0.15], [1.1, 0.8, 0.4])).float()
    return mesh.replace(verts=n / n.abs().amax(1, keepdim=True) * half, texture=atlas)


def _cushion(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    """Return a box with round corners, a superellipsoid, with other axes and a print."""
    mesh, power = pebble(), float(rng.uniform(2.5, 6.0))
    n, half = (
        F.normalize(mesh.verts / STONE_AXES, dim=1),
        torch.from_numpy(rng.uniform([0.9, 0.5, 0.3], [1.1, 0.8, 0.6])),
    )
    radius = (n / half.float()).abs().pow(power).sum(1, keepdim=True).pow(-1.0 / power)
    return _smooth(mesh.replace(verts=n * radius, texture=_print(photographs, (256, 256), rng)))


def _vase(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    """Return a solid of revolution with a random profile and a label around it."""
    return _smooth(_grid(_revolved(rng.uniform(0.25, 0.7, 5), 0.9), _print(photographs, (192, 384), rng)))


def _mug(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    """Return a solid of revolution with a handle."""
    body = _revolved(np.full(5, rng.uniform(0.45, 0.6)) * rng.uniform(0.9, 1.1, 5), 0.65)
    angle = torch.linspace(-1.7, 1.7, 25)
    place = torch.stack([0.45 + 0.45 * angle.cos(), 0.42 * angle.sin(), torch.zeros_like(angle)], 1)
    parts = [_grid(one, _print(photographs, (192, 384), rng)) for one in (body, _tube(place, 0.09))]
    count = len(parts[0].verts)
    uvs = [part.uvs for part in parts if part.uvs is not None]
    verts, faces = torch.cat([part.verts for part in parts]), torch.cat([parts[0].faces, parts[1].faces + count])
    return _smooth(eg.Mesh(verts, faces, texture=parts[0].texture, uvs=torch.cat(uvs), uv_faces=faces))


def _knot(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    """Return a tube in the form of a trefoil knot, with other blotches."""
    a = torch.linspace(0.0, 2.0 * math.pi, 121)
    place = torch.stack([a.sin() + 2 * (2 * a).sin(), a.cos() - 2 * (2 * a).cos(), -(3 * a).sin()], 1) / 3.0
    return _smooth(_grid(_tube(place, float(rng.uniform(0.13, 0.22))), blotches(256, int(rng.integers(1 << 30)))))


def _bracket(rng: np.random.Generator, photographs: Sequence[Tensor]) -> eg.Mesh:
    """Return an L of 20 triangles with colours of its own."""
    mesh = bracket().to(torch.float32)
    assert mesh.face_colors is not None
    mixed = mesh.face_colors @ torch.from_numpy(rng.dirichlet(np.full(3, 0.7), 3)).float().T
    return mesh.replace(face_colors=mixed.clamp(0.02, 0.95))


def _revolved(radii: np.ndarray, height: float, around: int = 40, along: int = 33) -> Tensor:
    """Return points (along, around + 1, 3) of a solid of revolution about y through radii, closed at both ends."""
    y = np.linspace(-1.0, 1.0, along - 2)
    r = np.interp(y, np.linspace(-1.0, 1.0, len(radii)), radii)
    r, y = (torch.from_numpy(x).float() for x in (np.r_[1e-3, r, 1e-3], height * np.r_[-1.0, y, 1.0]))
    angle = torch.linspace(0.0, 2.0 * math.pi, around + 1)
    return torch.stack([r[:, None] * angle.cos(), y[:, None].expand(-1, around + 1), r[:, None] * angle.sin()], -1)


def _tube(place: Tensor, radius: float, around: int = 12) -> Tensor:
    """Return points (n, around + 1, 3) of a tube along points (n, 3)."""
    tangent = F.normalize(torch.gradient(place, dim=0)[0], dim=1)
    side = F.normalize(torch.linalg.cross(tangent, torch.tensor([0.05, 0.1, 1.0]).expand_as(tangent)), dim=1)
    angle = torch.linspace(0.0, 2.0 * math.pi, around + 1)[:, None]
    ring = angle.cos() * side[:, None] + angle.sin() * torch.linalg.cross(tangent, side)[:, None]
    return place[:, None] + radius * ring


def _grid(points: Tensor, texture: Tensor) -> eg.Mesh:
    """Return the mesh of a grid of points (n, m, 3) with a texture over it."""
    n, m = points.shape[:2]
    at = torch.arange(n * m).reshape(n, m)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    faces = torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)]).reshape(-1, 3)
    v, u = torch.meshgrid(torch.linspace(0.0, 1.0, n), torch.linspace(0.0, 1.0, m), indexing="ij")
    return eg.Mesh(
        points.reshape(-1, 3), faces, texture=texture, uvs=torch.stack([u, v], -1).reshape(-1, 2), uv_faces=faces
    )


def _smooth(mesh: eg.Mesh) -> eg.Mesh:
    return mesh.replace(normals=mesh.vertex_normals())


OBJECTS: dict[str, Callable[[np.random.Generator, Sequence[Tensor]], eg.Mesh]] = {
    "stone": _stone, "carton": _carton, "cushion": _cushion, "vase": _vase, "mug": _mug, "knot": _knot, "bracket": _bracket,
}  # fmt: skip
