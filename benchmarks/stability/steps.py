"""Discontinuities within faces: the error of the gradient against the spacing of the lines that find them.

Each painting has a size t, and the derivative of its painted area by t is known. The lines of the report are those that
`Sampling.discontinuity_spacing` lays through the image: what a shader declares, and what the kernel knows of itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.points.hits import Hits
from edgegrad.render import render
from edgegrad.sampling import Sampling
from edgegrad.scene.mesh import Mesh

F64 = torch.float64
SIZE, SCALE = 64, 25.6  # px of the image's side, and of a unit
SPACINGS = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)
SEEDS = 48
RADIUS, MIDDLE = 0.6, 0.05  # of the disc: 31 px wide
STRIPE = 3.2 / SCALE  # the width of a stripe, and of the gap next to it
TEXELS = 10, 3.2 / SCALE  # of a painting of texels, on a side, and their width
ALPHAS = 128  # texels of alpha on a side, 0.4 px wide: of lines that lie far apart some texels stand for all

Painter = Callable[[Tensor, Tensor], Tensor]
Painting = Callable[[Tensor], tuple[Mesh, Callable[[Hits], Tensor] | None]]


class Case(NamedTuple):
    """A painting: mesh and shader as functions of t, and the derivative of its area at t = 0, in square units."""

    paint: Painting
    area: float


def measure(quick: bool = False, say: Callable[[str], Any] = lambda text: None) -> dict[str, Any]:
    """Return rows with the errors and times of each case, by spacing.

    Errors are relative to the correct derivative: the mean error, its standard error, and the root mean square error of one
    image. Times are of an image and its gradient.
    """
    seeds = SEEDS // 4 if quick else SEEDS
    rows = []
    for spacing in SPACINGS:
        row: dict[str, Any] = {"spacing": spacing, "cases": {}}
        for name, case in cases().items():
            say(f"{name}, lines {spacing:g} px apart")
            begin = time.perf_counter()
            ratio = torch.stack([derivative(case, spacing, seed) for seed in range(seeds)]) / (case.area * SCALE**2)
            row["cases"][name] = {
                "bias": float(ratio.mean()) - 1, "noise": float(ratio.std()) / seeds**0.5,
                "error": float((ratio - 1).square().mean().sqrt()), "seconds": (time.perf_counter() - begin) / seeds,
            }  # fmt: skip
        rows.append(row)
    return {"seeds": seeds, "rows": rows}


def derivative(case: Case, spacing: float, seed: int) -> Tensor:
    """Return the derivative of the sum of the image with respect to t."""
    K = torch.tensor([[SCALE, 0, SIZE / 2], [0, SCALE, SIZE / 2], [0, 0, 1]], dtype=F64)
    camera = Camera(torch.eye(4, dtype=F64), K, (SIZE, SIZE), "orthographic")
    t = torch.zeros((), dtype=F64, requires_grad=True)
    mesh, shader = case.paint(t)
    image = render(mesh, camera, seed=seed, shader=shader, sampling=Sampling(discontinuity_spacing=spacing))
    return torch.autograd.grad(image[..., 0].sum(), t)[0]


def cases() -> dict[str, Case]:
    stripes = 4 / STRIPE  # of each 2 · STRIPE of a line STRIPE + 2 t is painted
    texels = 2 * float(_board()[..., 0].sum()) * TEXELS[1] ** 2
    return {
        "disc, hits.where": Case(_by_shader(disc), 2 * math.pi * RADIUS),
        "disc, alpha": Case(_by_alpha(disc), 2 * math.pi * RADIUS),
        "stripes, hits.where": Case(_by_shader(stripes_of), stripes),
        "stripes, alpha": Case(_by_alpha(stripes_of), stripes),
        "texels, hits.sample": Case(_texels_by_shader, texels),
        "texels, texture": Case(_texels_by_texture, texels),
    }


# -- what is painted, where a function of place and size is above zero ------------------------------------------------


def disc(place: Tensor, t: Tensor) -> Tensor:
    """Paint a disc 31 px wide, whose radius grows with t: a polynomial of degree 2, which bilinear texels follow closely."""
    return (RADIUS + t) ** 2 - (place - MIDDLE).square().sum(-1)


def stripes_of(place: Tensor, t: Tensor) -> Tensor:
    """3.2 px wide, and as far apart; t grows half their width. Straight near its zeros: bilinear texels follow it exactly.
    A line across the square runs over eight stripes and eight gaps, wherever it begins."""
    x = (place[..., 0] + 0.3 * place[..., 1]).remainder(2 * STRIPE)
    return STRIPE / 2 - (x - STRIPE).abs() + t


def _square() -> Mesh:
    """[−1, 1]² before the camera, with texture coordinates from 0 to 1, v running up in the image."""
    corner = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = torch.stack([0.5 + 0.5 * corner[:, 0], 0.5 - 0.5 * corner[:, 1]], 1)
    return Mesh(corner, faces, uvs=uvs, uv_faces=faces, wrap="clamp")


def _by_shader(painter: Painter) -> Painting:
    return lambda t: (_square(), lambda hits: hits.where(painter(hits.position[:, :2], t), 1.0, 0.0))


def _by_alpha(painter: Painter) -> Painting:
    def paint(t: Tensor) -> tuple[Mesh, None]:
        centre = (torch.arange(ALPHAS, dtype=F64) + 0.5) * (2 / ALPHAS) - 1
        y, x = torch.meshgrid(centre, centre, indexing="ij")
        alpha = painter(torch.stack([x, y], -1), t)
        return _square().replace(alpha=alpha, alpha_cutoff=0.0, face_colors=torch.ones((2, 1), dtype=F64)), None

    return paint


def _board() -> Tensor:
    """Return a checkerboard (h, w, 1) before black."""
    n = TEXELS[0]
    dark = (torch.arange(n)[:, None] + torch.arange(n)) % 2
    return torch.nn.functional.pad(dark.to(F64), (1, 1, 1, 1))[..., None]


def _turned(t: Tensor) -> Mesh:
    """Set texture coordinates that show the board rotated in the middle of the square, scaled by 1 + t."""
    mesh = _square()
    c, s = math.cos(0.5), math.sin(0.5)
    turn = torch.tensor([[c, -s], [s, c]], dtype=F64)
    size = (TEXELS[0] + 2) * TEXELS[1]
    return mesh.replace(uvs=0.5 + mesh.verts[:, :2] @ turn / (size * (1 + t)))


def _texels_by_shader(t: Tensor) -> tuple[Mesh, Callable[[Hits], Tensor]]:
    return _turned(t), lambda hits: hits.sample(_board(), wrap="clamp", filter="nearest")


def _texels_by_texture(t: Tensor) -> tuple[Mesh, None]:
    return _turned(t).replace(texture=_board(), filter="nearest"), None
