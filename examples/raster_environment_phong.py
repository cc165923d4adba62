"""Find the environment that a shiny ball mirrors, and the ball's Phong highlight, from pictures in random poses.

    python examples/raster_environment_phong.py [--steps 1000] [--size 128] [--out environment.png]

Radiance is what the cube map shows in the mirrored direction, plus colour × max(0, r · l)^exponent of a light in a known
direction (Phong 1975). The cube map, the colour and the exponent are found.
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import torch
from raster_earth import globe
from raster_views import descend, in_clip_space, perspective, rotations
from torch import Tensor

import edgegrad as eg
import edgegrad.raster as dr

SIDE = 32  # texels along an edge of the cube map
LIGHT = torch.tensor([0.0, 0.0, 1.0])  # where it is, as the eye sees it


class Appearance(NamedTuple):
    environment: Tensor  # (1, 6, SIDE, SIDE, 3)
    color: Tensor  # (3,)
    log_exponent: Tensor


def truth(generator: torch.Generator) -> Appearance:
    """Return a sky over ground, with lights of all colours."""
    center = (torch.arange(SIDE) + 0.5) / SIDE * 2 - 1
    t, s = torch.meshgrid(center, center, indexing="ij")
    one = torch.ones_like(s)
    sides = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]  # OpenGL's
    direction = torch.nn.functional.normalize(torch.stack([torch.stack(side, 2) for side in sides]), dim=3)
    up = direction[..., 1:2]
    sky = torch.where(up > 0, torch.tensor([0.3, 0.5, 0.8]) + 0.3 * up, torch.tensor([0.35, 0.25, 0.15]))
    emitters = torch.nn.functional.normalize(torch.randn(12, 3, generator=generator), dim=1)
    glow = torch.exp(40 * (direction @ emitters.T - 1)) @ torch.rand(12, 3, generator=generator)
    return Appearance((sky + glow)[None], torch.tensor([0.6, 0.5, 0.3]), torch.tensor(math.log(25.0)))


class Ball:
    def __init__(self) -> None:
        self.verts, _, self.tri = globe()

    def picture(self, ball: Appearance, R: Tensor, size: int) -> Tensor:
        """Return pictures (B, size, size, 3), whose eye moves around the ball."""
        pos = in_clip_space(self.verts, R, 3.0, perspective())
        eye = 3.0 * R[:, 2]  # of which R makes (0, 0, 3)
        rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos, self.tri, (size, size))
        view = self.verts - eye[:, None]
        mirrored = view - 2 * (view * self.verts).sum(2, keepdim=True) * self.verts  # a unit sphere is its own normal
        mirrored, mirrored_da = dr.interpolate(mirrored, rast, self.tri, rast_db, "all")
        image = dr.texture(ball.environment, mirrored, mirrored_da, boundary_mode="cube")
        to_light = torch.einsum("bij,i->bj", R, LIGHT)[:, None, None]
        cosine = (torch.nn.functional.normalize(mirrored, dim=3) * to_light).sum(3, keepdim=True)
        highlight = ball.color * cosine.clamp(min=1e-4) ** ball.log_exponent.exp()
        return torch.where(rast[..., 3:] > 0, image + highlight, 0.0)


class Errors(NamedTuple):
    environment: float  # root of the mean square
    color: float
    exponent: float  # relative


def fit(steps: int = 1000, size: int = 128, seed: int = 0) -> tuple[Appearance, Errors, Errors]:
    """Return what was found, with the errors before and after."""
    generator = torch.Generator().manual_seed(seed)
    true, of = truth(generator), Ball()
    found = Appearance(torch.full_like(true.environment, 0.5), torch.full((3,), 0.3), torch.tensor(math.log(10.0)))
    found = Appearance(*(part.requires_grad_() for part in found))

    def errors() -> Errors:
        with torch.no_grad():
            off = [(a - b).square().mean().sqrt() for a, b in zip(found, true, strict=True)]
            return Errors(float(off[0]), float(off[1]), float((found.log_exponent - true.log_exponent).exp() - 1))

    before = errors()
    optimizer = torch.optim.Adam([{"params": [found.environment]}, {"params": [*found[1:]], "lr": 0.05}], lr=1e-2)

    def loss() -> Tensor:
        R = rotations(1, generator)
        with torch.no_grad():
            target = of.picture(true, R, size)
        return (of.picture(found, R, size) - target).square().mean()

    descend(optimizer, loss, steps, 0.02, "environment")
    return Appearance(*(part.detach() for part in found)), before, errors()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out")
    options = parser.parse_args()
    ball, *both = fit(options.steps, options.size)
    for name, off in zip(("before", "after"), both, strict=True):
        print(f"{name:7s} environment {off.environment:.3f}   colour {off.color:.4f}   exponent {off.exponent:+.2%}")
    if options.out:
        eg.write_image(options.out, torch.cat(list(ball.environment[0]), 1))
