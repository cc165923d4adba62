"""Find a shape from its shadow alone: the pictures show nothing but the ground, under lights from several directions.

    python examples/shadow.py [--out shadow.png]

Without gradients of the shadows' borders there would be none at all: no surface in view depends on the shape.
"""

from __future__ import annotations

import argparse
import math

import torch
import trimesh
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg

SIZE = 64
HEIGHT = 1.2  # of the middle of the shape, above the ground
SMOOTH = 8.0  # how much a rough shape costs: inside of its silhouettes no light says anything about it


class Shape:
    """A ball whose vertices stand at distances of their own from its middle."""

    def __init__(self, level: int = 3) -> None:
        made = trimesh.creation.icosphere(level)
        self.directions = torch.tensor(made.vertices, dtype=torch.float32)
        self.faces = torch.tensor(made.faces)
        self.edges = torch.tensor(made.edges_unique)
        degree = torch.bincount(self.edges.reshape(-1), minlength=len(self.directions))
        self.degree = degree.to(self.directions)[:, None]

    def truth(self) -> Tensor:
        """Return the distances (V,) that are to be found: bumps on an egg."""
        x, y, z = self.directions.unbind(1)
        return 0.55 + 0.16 * x + 0.1 * torch.sin(3 * torch.atan2(y, x)) * (1 - z * z) - 0.12 * z * z

    def mesh(self, distance: Tensor) -> eg.Mesh:
        verts = distance[:, None] * self.directions + torch.tensor([0.0, 0.0, HEIGHT])
        return eg.Mesh(verts, self.faces, material=eg.Material(base_color=torch.tensor([0.7, 0.7, 0.7])))

    def roughness(self, distance: Tensor) -> Tensor:
        """Return the mean square distance of vertices from the mean of their neighbours."""
        a, b = self.edges.unbind(1)
        total = torch.zeros_like(distance).index_add(0, a, distance[b]).index_add(0, b, distance[a])
        return (total / self.degree[:, 0] - distance).square().mean()


def ground() -> eg.Mesh:
    """Return the white plane z = 0."""
    white = eg.Material(base_color=torch.tensor([0.8, 0.8, 0.8]))
    return eg.shapes.rectangle(u=(6.0, 0.0, 0.0), v=(0.0, 6.0, 0.0), material=white)


def lights(count: int = 12) -> list[eg.lights.DirectionalLight]:
    """Return lights around the axis, some high, some low."""
    found = []
    for k in range(count):
        azimuth, elevation = 2 * math.pi * k / count + 0.2, math.radians((80.0, 55.0, 38.0)[k % 3])
        flat = math.cos(elevation)
        direction = torch.tensor([flat * math.cos(azimuth), flat * math.sin(azimuth), -math.sin(elevation)])
        found.append(eg.lights.DirectionalLight(direction, math.pi / math.sin(elevation)))
    return found


def fit(steps: int = 240, size: int = SIZE) -> tuple[list[Tensor], Shape, Tensor]:
    """Return pictures of one light's shadow (target, start, end), the shape, and the distances (V,) that were found."""
    shape, suns = Shape(), lights()
    # From under the shape, which is behind the camera, straight down.
    camera = eg.Camera.look_at((0.0, 0.0, 0.55), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 155.0, (size, size))

    def picture(distance: Tensor, k: int, spp: int, seed: int) -> Tensor:
        return eg.render(eg.Scene([shape.mesh(distance), ground()], lights=[suns[k]]), camera, spp, seed)

    def mean(distance: Tensor, k: int, seed: int) -> Tensor:
        # A mean over seeds: a face is shaded at few points of a pixel, however many samples it has.
        with torch.no_grad():
            return torch.stack([picture(distance, k, 8, seed + i) for i in range(8)]).mean(0)

    targets = [mean(shape.truth(), k, 10_000) for k in range(len(suns))]
    start = torch.full((len(shape.directions),), 0.45)
    found = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([found], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-4)
    for step in tqdm(range(steps), desc="shadow"):
        k = step % len(suns)
        loss = (picture(found, k, 8, step) - targets[k]).square().mean() + SMOOTH * shape.roughness(found)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return [targets[2], mean(start, 2, 20_000), mean(found, 2, 20_000)], shape, found.detach()


def look(shape: Shape, distance: Tensor) -> Tensor:
    """Return a picture of the shape itself, which the fit never sees."""
    camera = eg.Camera.look_at((1.6, -2.4, 2.6), (0.0, 0.0, HEIGHT), (0.0, 0.0, 1.0), 34.0, (SIZE, SIZE))
    sky = torch.zeros(9, 3).index_fill(0, torch.tensor(0), 1.5)
    suns = [eg.lights.DirectionalLight(torch.tensor([-1.0, 0.6, -1.0]), 2.5), eg.lights.SphericalHarmonics(sky)]
    with torch.no_grad():
        return eg.render(eg.Scene(shape.mesh(distance), lights=suns), camera, 64)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="shadow.png")
    out = parser.parse_args().out
    pictures, shape, found = fit()
    truth = shape.truth()
    shapes = [look(shape, d) for d in (truth, torch.full_like(truth, 0.45), found)]
    eg.write_image(out, torch.cat([torch.cat(pictures, 1), torch.cat(shapes, 1)]).clamp(0, 1))
    before, after = ((d - truth).square().mean().sqrt() / truth.mean() for d in (torch.full_like(truth, 0.45), found))
    print(f"error of the radius: {before:.1%} before, {after:.1%} after")
    print(f"{out}: shadows (target, start, end) and below them the shapes")
