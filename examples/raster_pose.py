"""Find the pose of a cube with sides of six colours from one picture: first by trying, then by gradients.

    python examples/raster_pose.py [--trials 20] [--size 256]

The first quarter of the steps draws random poses, some of them around the best so far, and keeps what comes nearest to a small
picture; the rest follows the gradient. Prints by how many degrees each pose is off.
"""

from __future__ import annotations

import argparse
import math

import torch
from raster_views import cube, descend, in_clip_space, of_quaternions, perspective
from torch import Tensor
from tqdm import tqdm

import edgegrad.raster as dr

SMALL, TRIED = 32, 64  # pixels of the pictures that are compared at first, and how many a step
COLORS = torch.tensor(
    [[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.1, 0.3, 0.9], [0.9, 0.8, 0.1], [0.8, 0.2, 0.8], [0.1, 0.8, 0.8]]
)


def picture(q: Tensor, size: int) -> Tensor:
    """Return pictures (B, size, size, 3) of quaternions (B, 4)."""
    verts, tri, side = cube()
    pos = in_clip_space(verts, of_quaternions(q), 6.0, perspective())
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (size, size))
    image, _ = dr.interpolate(COLORS[None], rast, side)
    return dr.antialias(image, rast, pos, tri)


def difference(image: Tensor, target: Tensor) -> Tensor:
    """Return the differences (B,) of pictures at four scales: coarse ones have a slope where fine ones no longer
    meet."""
    total = torch.zeros(len(image))
    for _ in range(4):
        total = total + (image - target).square().mean((1, 2, 3))
        image, target = (
            torch.nn.functional.avg_pool2d(x.permute(0, 3, 1, 2), 2).permute(0, 2, 3, 1) for x in (image, target)
        )
    return total


def degrees_apart(a: Tensor, b: Tensor) -> float:
    cosine = float((a / a.norm() * b / b.norm()).sum().abs().clamp(max=1))
    return math.degrees(2 * math.acos(cosine))


def product(p: Tensor, q: Tensor) -> Tensor:
    """Return the product of quaternions (B, 4): first q, then p."""
    scalar = p[:, :1] * q[:, :1] - (p[:, 1:] * q[:, 1:]).sum(1, keepdim=True)
    return torch.cat([scalar, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + torch.linalg.cross(p[:, 1:], q[:, 1:])], 1)


def fit(seed: int, steps: int = 400, size: int = 256) -> tuple[float, float, float]:
    """Return by how many degrees the start, the best that was tried, and the last pose are off."""
    generator = torch.Generator().manual_seed(seed)
    truth, best = (torch.randn(1, 4, generator=generator) for _ in range(2))
    start = degrees_apart(best[0], truth[0])
    with torch.no_grad():
        target, small = picture(truth, size), picture(truth, SMALL)
        least, tries = float(difference(picture(best, SMALL), small)), steps // 4
        for step in range(tries):
            # Three in four anywhere, the others near the best, ever nearer.
            spread = 0.5 ** (8 * step / tries)
            turn = torch.nn.functional.pad(spread * torch.randn(TRIED, 3, generator=generator), (1, 0), value=1.0)
            some = product(turn, best.expand(TRIED, -1))
            some[TRIED // 4 :] = torch.randn(TRIED - TRIED // 4, 4, generator=generator)
            found = difference(picture(some, SMALL), small)
            if float(found.min()) < least:
                least, best = float(found.min()), some[found.argmin()][None]
    tried = degrees_apart(best[0], truth[0])
    q = (best / best.norm()).requires_grad_()
    optimizer = torch.optim.Adam([q], lr=1e-2)
    descend(optimizer, lambda: difference(picture(q, size), target).sum(), steps - tries, 0.02)
    return start, tried, degrees_apart(q.detach()[0], truth[0])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--size", type=int, default=256)
    options = parser.parse_args()
    found = [fit(seed, options.steps, options.size) for seed in tqdm(range(options.trials), desc="pose")]
    for row in found:
        print("start {:6.1f}°   tried {:6.1f}°   found {:8.4f}°".format(*row))
    print(f"within a degree: {sum(last < 1 for _, _, last in found)} of {len(found)}")
