"""Stiff scenes: gradients of very unlike size in one loss, and nearly nothing to see."""

from __future__ import annotations

import math

import torch
from oracles.exact import exact_image

from edgegrad.sampling import Sampling
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import background, smooth_adjoint, smooth_colors
from .camera import ORIGIN, upright, vector
from .case import F64, Group, Problem, everything
from .geometry import CAMERA, of_faces, on_screen
from .scale import tilted_cube

group = Group("stiff")
WARM = of_faces((0.9, 0.4, 0.2), (0.3, 0.8, 0.6), (0.5, 0.2, 0.9))
TRIANGLE = torch.tensor([[-0.31, -0.26, 0.06], [0.33, -0.18, -0.05], [0.02, 0.34, 0.02]], dtype=F64)


@group.add("decades-12", "vertex gradients 12 decades apart: a triangle at 1e-3 units before one at 1e9")
def decades() -> Problem:
    face = torch.tensor([[0, 1, 2]])
    near = Mesh(1e-3 * (TRIANGLE + vector(-0.12, -0.1, -1.0)), face, colors=smooth_colors(3 * TRIANGLE))
    far = Mesh(1e9 * (0.7 * TRIANGLE + vector(0.14, 0.12, -1.0)), face, colors=smooth_colors(5 * TRIANGLE))
    return everything(
        Scene([near, far], background()), upright(ORIGIN), names=(" of the near", " of the far"), camera_too=False
    )


@group.add("speck", "a cube of 0.05 px, 1e6 units away, beside one that fills the image", slow=True)
def speck() -> Problem:
    near = tilted_cube(0.2).transformed(t=vector(0.1, 0.05, -1.0))
    far = tilted_cube(5e2).transformed(t=vector(-4e5, 3.6e5, -1e6))
    return everything(
        Scene([near, far], background()), upright(ORIGIN), names=(" of the near", " of the far"), camera_too=False,
        options={"sampling": Sampling(surface=400_000, edges=400_000)},
    )  # fmt: skip


def _quadrants(colors: list[float]) -> Scene:
    middles = [(12.0, 12.0), (36.0, 12.0), (12.0, 36.0), (36.0, 36.0)]
    corners = torch.tensor([[-9.2, -7.3], [9.4, -5.1], [0.7, 9.6]], dtype=F64)
    meshes = []
    for (x, y), color in zip(middles, colors, strict=True):
        pixels = (corners + vector(x, y)).tolist()
        meshes.append(on_screen(pixels, [3.6, 4.1, 4.0], [[0, 1, 2]], colors=color * WARM))
    return Scene(meshes, torch.zeros(3, dtype=F64))


LEVELS = (1e-8, 1e-3, 1e3, 1e8)


@group.add("hdr", "colours from 1e-8 to 1e8 in one image")
def hdr() -> Problem:
    names = [f" at {level:g}" for level in LEVELS]
    return everything(_quadrants(list(LEVELS)), CAMERA, names=names, camera_too=False)


@group.add("hdr-adjoint", "adjoints from 1e-8 to 1e8 in one image")
def hdr_adjoint() -> Problem:
    level = torch.tensor(LEVELS, dtype=F64).reshape(2, 2).repeat_interleave(24, 0).repeat_interleave(24, 1)
    names = [f" at {level:g}" for level in LEVELS]
    adjoint = smooth_adjoint(48, 48, 3) * level[..., None]
    return everything(_quadrants([1.0] * 4), CAMERA, names=names, camera_too=False, adjoint=adjoint)


@group.add("adjoint-1e-8", "an adjoint of 1e-8, float32", 1e-8)
@group.add("adjoint-1e8", "an adjoint of 1e8, float32", 1e8)
def scaled_adjoint(level: float) -> Problem:
    scene = Scene([tilted_cube()], background()).to(torch.float32)
    return everything(scene, CAMERA, adjoint=level * smooth_adjoint(48, 48, 3))


@group.add("emerging-1e-3", "an edge 1e-3 px beyond the one that hides it", 1e-3)
@group.add("emerging-1e-6", "an edge 1e-6 px beyond the one that hides it", 1e-6)
@group.add("hiding-1e-6", "an edge 1e-6 px behind the one that hides it", -1e-6)
@group.add("hiding-1e-3", "an edge 1e-3 px behind the one that hides it", -1e-3)
def grazing(beyond: float) -> Problem:
    """At zero the gradient jumps; on both sides it must be that of the side."""
    front = on_screen([[6.3, 21.2], [43.1, 27.4], [20.4, 44.1]], [3.4, 3.6, 3.5], [[0, 1, 2]], colors=WARM)
    along = vector(43.1 - 6.3, 27.4 - 21.2) / math.hypot(43.1 - 6.3, 27.4 - 21.2)
    up = vector(along[1].item(), -along[0].item())
    start = vector(6.3, 21.2)
    pixels = torch.stack(
        [start + 4.0 * along + beyond * up, start + 31.0 * along + beyond * up, start + 15.0 * along - 12.0 * up]
    )
    back = on_screen(pixels.tolist(), [4.4, 4.7, 4.5], [[0, 1, 2]], colors=1.0 - WARM)
    # Not the colours: of a strip as wide as that, no sample tells.
    return everything(Scene([front, back], background()), CAMERA, colors=False)


def _wire(width: float, contrast: float) -> Mesh:
    a, b = vector(6.2, 9.1), vector(41.7, 37.3)
    along = (b - a) / (b - a).norm()
    across = 0.5 * width * vector(-along[1].item(), along[0].item())
    pixels = torch.stack([a - across, b - across, b + across, a + across])
    colors = background() + contrast * of_faces((1.0, 0.5, -0.7), (0.4, 1.0, 0.8), (-0.6, 0.8, 1.0), (0.9, -0.3, 0.5))
    return on_screen(pixels.tolist(), [3.7, 4.3, 4.3, 3.7], [[0, 1, 2], [0, 2, 3]], colors=colors)


@group.add("wire", "a wire 0.1 px wide, its colour 1e-3 from that of the background", 1e-3)
@group.add("wire-1e-9", "a wire 0.1 px wide, its colour 1e-9 from that of the background", 1e-9)
def wire(contrast: float) -> Problem:
    return everything(Scene([_wire(0.1, contrast)], background()), CAMERA, camera_too=False, spp=1024)


@group.add("one-pixel-loss", "a loss that looks at one pixel, on a silhouette")
def one_pixel() -> Problem:
    scene = Scene([tilted_cube()], background())
    white = tilted_cube().replace(colors=torch.ones((8, 1), dtype=F64))
    coverage = exact_image(Scene([white]), CAMERA)[..., 0]
    y, x = torch.nonzero((coverage > 0.4) & (coverage < 0.6))[0].tolist()
    adjoint = torch.zeros((48, 48, 3), dtype=F64)
    adjoint[y, x] = vector(1.0, -0.5, 0.3)
    return everything(scene, CAMERA, adjoint=adjoint)
