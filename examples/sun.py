"""Find where the sun stands, and how an object lies, from one picture of the object and its shadow.

    python examples/sun.py [--out sun.png]

Shading and shadow show the sun's direction; silhouette, texture and shadow show the pose. The border of the shadow has a
gradient by both.
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg

SIZE = 96


def knot(along: int = 160, around: int = 20) -> eg.Mesh:
    """Return a trefoil knot with stripes and interpolated normals."""
    t = 2 * math.pi * torch.arange(along) / along
    curve = 0.28 * torch.stack([t.sin() + 2 * (2 * t).sin(), t.cos() - 2 * (2 * t).cos(), -1.2 * (3 * t).sin()], 1)
    tangent = torch.nn.functional.normalize(curve.roll(-1, 0) - curve.roll(1, 0), dim=1)
    side = torch.nn.functional.normalize(torch.linalg.cross(tangent, torch.tensor([[0.0, 0.0, 1.0]])), dim=1)
    angle = (2 * math.pi * torch.arange(around) / around)[None, :, None]
    ring = angle.cos() * side[:, None] + angle.sin() * torch.linalg.cross(side, tangent)[:, None]
    verts = (curve[:, None] + 0.17 * ring).reshape(-1, 3)

    i, j = torch.meshgrid(torch.arange(along), torch.arange(around), indexing="ij")
    corners = torch.stack([torch.stack([i + a, j + b], -1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], -2)
    corners = corners.reshape(-1, 4, 2)
    index = corners[..., 0] % along * around + corners[..., 1] % around
    uv_index = corners[..., 0] * (around + 1) + corners[..., 1]
    uvs = torch.cartesian_prod(torch.linspace(0, 1, along + 1), torch.linspace(0, 1, around + 1))
    halves = torch.tensor([[0, 1, 2], [0, 2, 3]])
    faces = index[:, halves].reshape(-1, 3)

    u, v = (2 * math.pi * (torch.arange(n) + 0.5) / n for n in (512, 64))
    stripes = torch.sigmoid(8 * torch.sin(18 * u + 3 * v[:, None]))[..., None]
    hue = 0.5 + 0.4 * torch.cos(u[:, None] + torch.tensor([0.0, 2.1, 4.2]))
    return eg.Mesh(
        verts,
        faces,
        texture=stripes * hue + (1 - stripes) * 0.85,
        uvs=uvs,
        uv_faces=uv_index[:, halves].reshape(-1, 3),
        normals=eg.Mesh(verts, faces).vertex_normals(),
        material=eg.Material(),
    )


def ground() -> eg.Mesh:
    """Return a checkerboard at z = 0."""
    board = 0.42 + 0.1 * ((torch.arange(8)[:, None] + torch.arange(8)) % 2)[..., None] * torch.ones(3)
    board = board.repeat_interleave(16, 0).repeat_interleave(16, 1)
    return eg.shapes.rectangle(u=(4.0, 0.0, 0.0), v=(0.0, 4.0, 0.0), material=eg.Material()).replace(texture=board)


class Guess(NamedTuple):
    """What is to be found."""

    turn: Tensor  # (3,) radians about an axis
    shift: Tensor  # (3,)
    sun: Tensor  # (3,) the direction of its light

    @property
    def R(self) -> Tensor:
        x, y, z = self.turn.unbind()
        o = torch.zeros_like(x)
        return torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3))

    def scene(self) -> eg.Scene:
        sky = torch.zeros(9, 3).index_fill(0, torch.tensor(0), 1.0) * torch.tensor([0.9, 1.1, 1.4])
        sunlight = eg.lights.DirectionalLight(self.sun, 2.6, torch.tensor([1.0, 0.93, 0.8]))
        return eg.Scene(
            [knot().transformed(self.R, self.shift), ground()],
            background=torch.tensor([0.35, 0.5, 0.75]),
            lights=[sunlight, eg.lights.SphericalHarmonics(sky)],
        )

    def errors(self, truth: Guess) -> tuple[float, float, float]:
        """Return degrees of the sun, degrees of the pose, distance."""
        here, there = (Guess(*(part.double() for part in guess)) for guess in (self, truth))
        a, b = (torch.nn.functional.normalize(guess.sun, dim=0) for guess in (here, there))
        # By sines, which show small angles: |a − b| = 2 sin(θ / 2), and the Frobenius norm of R − Q is √8 sin(θ / 2).
        sines = (a - b).norm() / 2, (here.R - there.R).norm() / math.sqrt(8)
        angles = [math.degrees(2 * math.asin(sine.item())) for sine in sines]
        return angles[0], angles[1], (here.shift - there.shift).norm().item()


TRUTH = Guess(torch.tensor([1.2, 0.3, 0.4]), torch.tensor([0.0, 0.0, 1.05]), torch.tensor([-0.8, 0.55, -1.0]))
START = Guess(torch.tensor([1.05, 0.45, 0.5]), torch.tensor([0.14, -0.1, 1.2]), torch.tensor([-0.4, 0.75, -1.0]))


def view(size: int) -> eg.Camera:
    return eg.Camera.look_at((1.4, -4.6, 3.4), (-0.45, 0.3, 0.6), (0.0, 0.0, 1.0), 34.0, (size, size))


def picture(guess: Guess, camera: eg.Camera, seed: int, seeds: int = 16) -> Tensor:
    """Return a mean over seeds, since a face is shaded at few points of a pixel, however many samples it has."""
    with torch.no_grad():
        return torch.stack([eg.render(guess.scene(), camera, 16, seed + i) for i in range(seeds)]).mean(0)


def fit(target: Tensor, camera: eg.Camera, steps: int = 150) -> Guess:
    """Return what was found, from START."""
    found = Guess(*(value.clone().requires_grad_() for value in START))
    rates = Guess(0.015, 0.015, 0.03)  # pyright: ignore[reportArgumentType]
    optimizer = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(found, rates, strict=True)])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-4)
    for _ in tqdm(range(steps), desc="sun"):
        loss = (eg.render(found.scene(), camera, 8) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return Guess(*(leaf.detach() for leaf in found))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="sun.png")
    out = parser.parse_args().out
    camera = view(SIZE)
    target = picture(TRUTH, camera, 10_000)
    found = fit(target, camera)
    eg.write_image(out, torch.cat([target, *(picture(guess, camera, 20_000) for guess in (START, found))], 1))
    for name, guess in (("start", START), ("end", found)):
        sun, pose, shift = guess.errors(TRUTH)
        print(f"{name}: the sun is off by {sun:.2f}°, the pose by {pose:.2f}° and {shift:.4f}")
    print(f"{out}: target, start, end")
