"""Find roughness, metallic and base colour of a thing from 8 pictures of it under a known sky.

    python examples/material.py [MESH] [--size 128] [--out material.png]

First a ball of one colour, by Gauss-Newton. Then a scan, any file with a texture that load_mesh reads, or a painted stone, by
Adam: its base colour is a texture, its roughness and metallic are two numbers. First the texture has an eighth as many rows and
the pictures half as many, for a darker metal looks much like one that is less of a metal and brighter, and steps of a few
thousand numbers along there cost little. The picture shows each as it is, at the start and as it was found, from a side that was
not among the eight.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import objects
import torch
import torch.nn.functional as F
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, fit_scene
from edgegrad.fit.descent.result import Fit

ROUGHNESS, METALLIC = 0.3, 0.7
GOLD = torch.tensor([0.9, 0.65, 0.25])
VIEWS = 8


def sky() -> eg.lights.Environment:
    """Return a sky that is brighter above than below, with three lights."""
    image = torch.linspace(0.9, 0.15, 64)[:, None, None] * torch.tensor([0.9, 1.0, 1.15]).expand(64, 128, 3)
    for row, column, size, radiance in ((12, 20, 9, 6.0), (20, 84, 7, 9.0), (34, 52, 8, 4.0)):
        image[row : row + size, column : column + size] = radiance
    return eg.lights.Environment(image)


def ball() -> eg.Mesh:
    sphere = eg.shapes.sphere()
    return sphere.replace(normals=sphere.verts)


class Made(NamedTuple):
    """What a thing is made of."""

    base: Tensor  # (3,), or an image (h, w, 3)
    roughness: Tensor
    metallic: Tensor

    def scene(self, shape: eg.Mesh) -> eg.Scene:
        base = eg.Texture(self.base) if self.base.dim() == 3 else self.base
        material = eg.Material(base_color=base, metallic=self.metallic, roughness=self.roughness)
        return eg.Scene([shape.replace(texture=None, material=material)], lights=[sky()])

    def error(self, truth: Made) -> str:
        base = self.base - truth.base
        if base.dim() == 3:
            base = base.mean((0, 1))
        parts = ((self.roughness - truth.roughness).abs(), (self.metallic - truth.metallic).abs(), base.abs().max())
        return "roughness off by {:.4f}, metallic by {:.4f}, base colour by {:.4f}".format(*map(float, parts))


def pictures(scene: eg.Scene, cameras: list[eg.Camera]) -> list[Tensor]:
    with torch.no_grad():
        return [
            eg.render(scene, camera, 64, seed=10_000 + k, sampling=eg.Sampling(lights=2))
            for k, camera in enumerate(cameras)
        ]


def half(truth: Made) -> Made:
    """Return a grey that is half rough and half a metal."""
    return Made(*(torch.full_like(value, 0.5) for value in truth))


def fit(
    shape: eg.Mesh, truth: Made, size: int = 128, start: Made | None = None, rate: float = 0.02, **options: Any
) -> tuple[Fit, Made]:
    """Start from half() or another start, with learning rates of 0.02 of colours, and of the two numbers as given."""
    cameras = objects.around(shape, VIEWS, size)
    sought = {
        name: Parameter(0.02 if name == "base" else rate, value, low=0.0, high=1.0)
        for name, value in zip(Made._fields, start or half(truth), strict=True)
    }
    seen = pictures(truth.scene(shape), cameras)
    given = FitOptions(seed=0, **options)
    found = fit_scene(lambda values: Made(**values).scene(shape), seen, cameras, sought, options=given)
    return found, Made(**found.values)


def resized(image: Tensor, rows: int, columns: int) -> Tensor:
    planes = image.movedim(-1, 0)[None]
    return F.interpolate(planes, (rows, columns), mode="bilinear", antialias=True)[0].movedim(0, -1).clamp(0, 1)


def fit_textured(shape: eg.Mesh, truth: Made, size: int = 128, steps: tuple[int, int] = (300, 150)) -> tuple[Fit, Made]:
    """Fit coarse textures, then fine ones."""
    options: dict[str, Any] = {"spp": 4, "views_per_step": 2, "loss_tolerance": 0.0}
    rows, columns, _ = truth.base.shape
    start = half(truth)
    start = start._replace(base=start.base[: max(rows // 8, 1), : max(columns // 8, 1)].clone())
    first, found = fit(shape, truth, size // 2, start, steps=steps[0], **options)
    found = found._replace(base=resized(found.base, rows, columns))
    # The two numbers are found by now, and follow the finer texture slowly, for they have noise too.
    second, found = fit(shape, truth, size, found, 0.006, steps=steps[1], **options)
    return replace(second, start=first.start, seconds=first.seconds + second.seconds), found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out", default="material.png")
    args = parser.parse_args()
    scan = objects.load(args.mesh)
    if not isinstance(scan.texture, Tensor):
        parser.error("MESH: expected a mesh with a texture")
    numbers = torch.tensor(ROUGHNESS), torch.tensor(METALLIC)
    scan = scan.replace(normals=scan.vertex_normals())
    things = (
        (
            "ball",
            ball(),
            Made(GOLD, *numbers),
            partial(fit, method="gauss-newton", steps=50, spp=4, loss_tolerance=0.0),
        ),
        ("scan", scan, Made(scan.texture, *numbers), fit_textured),
    )
    rows = []
    for name, shape, truth, search in things:
        found, made = search(shape, truth, args.size)
        print(f"{name}: {made.error(truth)}; {found.seconds:.0f} s; {found.reason}", flush=True)
        camera = objects.around(shape, 13, args.size)[5]
        shown = truth.scene(shape), found.start, found.scene
        rows.append(torch.cat([pictures(scene, [camera])[0] for scene in shown], 1))
    eg.write_image(args.out, torch.cat(rows))
    print(f"{args.out}: as it is, at the start, as found")


if __name__ == "__main__":
    main()
