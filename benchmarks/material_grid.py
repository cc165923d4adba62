"""Balls of all materials, metallic × roughness as in Khronos' sample, besides the image of Mitsuba's `direct`
with the same scattering as a plugin: how far apart they are, in standard errors.

Run:  python -m benchmarks.material_grid [--out FILE.png] [--seeds N]          (with mitsuba installed)
"""

from __future__ import annotations

import argparse
import importlib.util
import math
from typing import Any

import numpy as np
import torch
from scipy.stats import t as student
from torch import Tensor
from torch.nn.functional import normalize
from tqdm import tqdm

import edgegrad as eg

from . import mitsuba
from .scenes import icosphere
from .stability.statistics import holm
from .table import Bench, Row, Skipped

METALLIC = (0.0, 0.5, 1.0)
ROUGHNESS = (0.1, 0.25, 0.5, 0.75, 1.0)
BASE = (0.9, 0.6, 0.3)
TILE = 16  # pixels a ball
HEIGHT, WIDTH = len(METALLIC) * TILE, len(ROUGHNESS) * TILE
EYE = (0.0, 0.0, 40.0)  # from so far that all balls look alike
FOV = 2 * math.degrees(math.atan(1.2 * len(METALLIC) / 40.0))  # 2.4 units are a tile
CHANCE = 0.01  # of a false alarm in a run, by Holm


def sky() -> Tensor:
    """Return a sky, brighter above, with three small lights."""
    image = torch.linspace(1.0, 0.2, 32)[:, None, None].repeat(1, 64, 3)
    for row, column, radiance in ((7, 12, 15.0), (10, 44, 25.0), (16, 30, 8.0)):
        image[row : row + 3, column : column + 3] = radiance
    return image


def places() -> list[tuple[float, float, float, float]]:
    """Return x and y of the centre, metallic and roughness of each ball."""
    rows, columns = len(METALLIC), len(ROUGHNESS)
    return [
        (2.4 * (j - (columns - 1) / 2), 2.4 * ((rows - 1) / 2 - i), METALLIC[i], ROUGHNESS[j])
        for i in range(rows)
        for j in range(columns)
    ]


def camera() -> eg.Camera:
    return eg.Camera.look_at(EYE, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), FOV, (HEIGHT, WIDTH))


def ours(seed: int) -> Tensor:
    shape = icosphere(5)  # Mitsuba's balls are round; ours of a quarter as many faces are 0.18 % darker
    verts = normalize(shape.verts.float(), dim=1)
    meshes = [
        eg.Mesh(
            verts + torch.tensor([x, y, 0.0]),
            shape.faces,
            normals=verts,
            material=eg.Material(base_color=torch.tensor(BASE), metallic=metallic, roughness=roughness),
        )
        for x, y, metallic, roughness in places()
    ]
    scene = eg.Scene(meshes, lights=[eg.lights.Environment(sky(), visible=False)])
    return eg.render(scene, camera(), spp=16, sampling=eg.Sampling(lights=16), seed=seed)


class Mitsuba:
    """Mitsuba's images, by LLVM where it is found, else by its scalar variant."""

    def __init__(self) -> None:
        try:
            mi, dr = mitsuba.load()
        except RuntimeError:
            mi, dr = (importlib.import_module(name) for name in ("mitsuba", "drjit"))
            mi.set_variant("scalar_rgb")
        self.mi = mi
        mitsuba.register(mi, dr)
        parts: dict[str, Any] = {
            "integrator": {"type": "direct", "hide_emitters": True},
            "sensor": mitsuba.sensor(mi, EYE, (0, 0, 0), FOV, (HEIGHT, WIDTH)),
            "sky": mitsuba.sky(mi, sky()),
        }
        for k, (x, y, metallic, roughness) in enumerate(places()):
            bsdf = mitsuba.bsdf(BASE, metallic, roughness)
            parts[f"ball{k}"] = {"type": "sphere", "center": [x, y, 0], "radius": 1.0, "bsdf": bsdf}
        self.scene = mi.load_dict({"type": "scene", **parts})

    def __call__(self, seed: int) -> Tensor:
        image = np.array(self.mi.render(self.scene, spp=16, seed=seed))
        return torch.from_numpy(image[..., :3])


def balls(images: Tensor) -> Tensor:
    """Return means (n, balls, 3) over the inner part of each ball, where both shapes are the same."""
    n = len(images)
    tiles = images.reshape(n, len(METALLIC), TILE, len(ROUGHNESS), TILE, 3).movedim(2, 3)
    tiles = tiles.reshape(n, -1, TILE, TILE, 3).double()
    y, x = torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="ij")
    inside = torch.hypot(x - TILE / 2 + 0.5, y - TILE / 2 + 0.5) < 0.27 * TILE
    return tiles[:, :, inside].mean(2)


def compared(seeds: int) -> tuple[Row, Tensor]:
    """Count the colours of balls that differ from Mitsuba's, and return that row and both images."""
    theirs = Mitsuba()
    found = [torch.stack([render(seed) for seed in tqdm(range(seeds))]) for render in (ours, theirs)]
    a, b = (balls(images) for images in found)
    noise = torch.stack([a.var(0), b.var(0)]).flatten(1) / seeds
    error = noise.sum(0).sqrt()
    freedom = noise.sum(0) ** 2 * (seeds - 1) / (noise**2).sum(0)  # Welch 1947
    z = ((a.mean(0) - b.mean(0)).flatten() / error).abs()
    rejected = holm(torch.from_numpy(2 * student.sf(z.numpy(), freedom.numpy())), CHANCE)
    size = b.mean(0).flatten()
    apart = float(((a.mean(0).flatten() - size) / size).abs().mean())
    note = (
        f"{len(z)} colours, apart by {100 * apart:.2f} % in the mean, of which noise explains "
        f"{100 * float((error / size).mean()) * math.sqrt(2 / math.pi):.2f} %; largest deviation {float(z.max()):.1f} "
        "standard errors"
    )
    row = Row("material grid: colours of balls that are not Mitsuba's", float(rejected.sum()), must=0.0, note=note)
    return row, torch.cat([images.mean(0).float() for images in found], 1)


def material_grid(bench: Bench) -> list[Row]:
    if importlib.util.find_spec("mitsuba") is None:
        raise Skipped("Mitsuba is not installed; pip install 'edgegrad[peers]'")
    return [compared(bench.repeats(16))[0]]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="material-grid.png")
    parser.add_argument("--seeds", type=int, default=16)
    args = parser.parse_args()
    row, picture = compared(args.seeds)
    eg.write_image(args.out, picture)
    print("  ".join(row.cells()), row.note)
