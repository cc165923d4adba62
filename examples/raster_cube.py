"""Find the corners and the colours of a cube from pictures of 4 to 16 pixels, by rasterize, interpolate and antialias.

    python examples/raster_cube.py [--size 16] [--steps 3000] [--exact] [--seed 0]

The start has each corner up to half an edge's half away, and random colours. Prints how far corners and colours are off.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import torch
from raster_views import cube, descend, in_clip_space, perspective, rotations
from torch import Tensor

import edgegrad.raster as dr

BATCH = 8  # views a step


class Errors(NamedTuple):
    corners: float  # mean distance, where an edge has length 2
    colors: float  # root of the mean square


def pictures(verts: Tensor, colors: Tensor, R: Tensor, size: int, exact: bool) -> Tensor:
    """Return pictures (B, size, size, 3)."""
    _, tri, side = cube()
    pos = in_clip_space(verts, R, 3.5, perspective(2.2))
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (size, size))
    image, _ = dr.interpolate(colors[None], rast, side)
    return dr.antialias(image, rast, pos, tri, exact=exact)


def fit(size: int = 16, steps: int = 3000, exact: bool = False, seed: int = 0) -> tuple[Errors, Errors]:
    """Return the errors before and after."""
    generator = torch.Generator().manual_seed(seed)
    truth, _, _ = cube()
    true_colors = torch.rand(6, 3, generator=generator)
    verts = (truth + torch.rand(8, 3, generator=generator) - 0.5).requires_grad_()
    colors = torch.rand(6, 3, generator=generator).requires_grad_()

    def errors() -> Errors:
        with torch.no_grad():
            return Errors(
                float((verts - truth).norm(dim=1).mean()), float((colors - true_colors).square().mean().sqrt())
            )

    before = errors()
    optimizer = torch.optim.Adam([verts, colors], lr=1e-2)

    def loss() -> Tensor:
        R = rotations(BATCH, generator)
        with torch.no_grad():
            target = pictures(truth, true_colors, R, size, exact)
        return (pictures(verts, colors, R, size, exact) - target).square().mean()

    descend(optimizer, loss, steps, 0.01, "cube")
    return before, errors()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=16)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    for name, found in zip(("before", "after"), fit(**vars(parser.parse_args())), strict=True):
        print(f"{name:7s} corners {found.corners:.4f}   colours {found.colors:.4f}")
