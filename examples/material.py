"""What a thing is made of: roughness, metallic and base colour, from 8 pictures of it under a sky that is known.

    python examples/material.py [MESH] [--size 128] [--out material.png]

First a ball of one colour, by Gauss-Newton. Then a scan, any file with a texture that load_mesh reads, or a painted stone, by
Adam: its base colour is a texture, its roughness and metallic are two numbers.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import objects
import torch
import trimesh
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import Fit, Parameter, fit_scene

ROUGHNESS, METALLIC = 0.3, 0.7
GOLD = torch.tensor([0.9, 0.65, 0.25])


def sky() -> eg.Environment:
    """Brighter above than below, with three lamps."""
    image = torch.linspace(0.9, 0.15, 64)[:, None, None] * torch.tensor([0.9, 1.0, 1.15]).expand(64, 128, 3)
    for row, column, size, radiance in ((12, 20, 9, 6.0), (20, 84, 7, 9.0), (34, 52, 8, 4.0)):
        image[row : row + size, column : column + size] = radiance
    return eg.Environment(image)


def ball() -> eg.Mesh:
    shape = trimesh.creation.icosphere(subdivisions=4)
    verts = torch.tensor(shape.vertices, dtype=torch.float32)
    return eg.Mesh(verts, torch.tensor(shape.faces), normals=verts)


def smooth(mesh: eg.Mesh) -> eg.Mesh:
    return mesh.replace(normals=eg.vertex_normals(mesh.verts, mesh.faces))


class Made(NamedTuple):
    """What a thing is made of."""

    base: Tensor  # (3,), or an image (h, w, 3)
    roughness: Tensor
    metallic: Tensor

    def scene(self, shape: eg.Mesh) -> eg.Scene:
        base = eg.Texture(self.base) if self.base.dim() == 3 else self.base
        material = eg.Material(base_color=base, metallic=self.metallic, roughness=self.roughness)
        return eg.Scene([shape.replace(texture=None, colors=None, material=material)], lights=[sky()])


def pictures(scene: eg.Scene, cameras: list[eg.Camera], spp: int = 256) -> list[Tensor]:
    with torch.no_grad():
        return [eg.render(scene, camera, spp, seed=10_000 + k) for k, camera in enumerate(cameras)]


def fit(shape: eg.Mesh, truth: Made, start: Made, size: int = 128, **options: Any) -> tuple[Fit, Made]:
    cameras = objects.around(shape, 8, size)
    rates = (0.02, 0.02, 0.02)
    sought = {
        name: Parameter(rate, value, low=0.0, high=1.0)
        for name, value, rate in zip(Made._fields, start, rates, strict=True)
    }
    found = fit_scene(
        lambda values: Made(**values).scene(shape), cameras, pictures(truth.scene(shape), cameras), sought, **options
    )
    return found, Made(**found.values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--size", type=int, default=128)
    args = parser.parse_args()
    roughness, metallic, half = torch.tensor(ROUGHNESS), torch.tensor(METALLIC), torch.tensor(0.5)
    found, made = fit(
        ball(),
        Made(GOLD, roughness, metallic),
        Made(half.expand(3), half, half),
        args.size,
        method="gauss-newton",
        spp=16,
        steps=60,
    )
    print("ball", found.seconds, found.reason, made)
    stone = smooth(objects.load(args.mesh))
    assert isinstance(stone.texture, Tensor)
    found, made = fit(
        stone,
        Made(stone.texture, roughness, metallic),
        Made(torch.full_like(stone.texture, 0.5), half, half),
        args.size,
        spp=4,
        steps=200,
    )
    print(
        "scan",
        found.seconds,
        found.reason,
        made.roughness,
        made.metallic,
        (made.base - stone.texture).abs().mean(),
        (made.base - stone.texture).square().mean().sqrt(),
    )


if __name__ == "__main__":
    main()
