"""Cameras of every lens, and gradients of what they show against finite differences of the image."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from finite_differences import Case, finite_difference, gradient, right_ratio, rotation
from scenes import icosphere
from torch import Tensor

import edgegrad as eg

F64 = torch.float64


DISTORTION = {
    "four": [-0.25, 0.08, 0.01, -0.02],
    "five": [-0.25, 0.08, 0.01, -0.02, 0.03],
    "eight": [0.3, 0.05, 0.01, -0.02, 0.02, 0.4, 0.1, 0.03],
    "fisheye": [-0.05, 0.04, -0.02, 0.01],
}
SIZE = (40, 48)


def camera(lens: str, skew: float = 1.5, size: tuple[int, int] = SIZE) -> eg.Camera:
    """A camera whose corners look 40° aside."""
    H, W = size
    K = torch.tensor([[0.94 * W, skew, 0.5 * W - 0.5], [0.0, 1.24 * H, 0.49 * H - 0.5], [0.0, 0.0, 1.0]], dtype=F64)
    make = eg.Camera.fisheye if lens == "fisheye" else eg.Camera.from_opencv
    R = rotation((0.0, 0.6, 0.8), torch.tensor(0.4, dtype=F64))
    return make(R, torch.tensor([0.1, -0.05, 3.0], dtype=F64), K, size, torch.tensor(DISTORTION[lens], dtype=F64))


def colored_sphere(dx: Tensor | float = 0.0, one_colour: bool = False) -> eg.Mesh:
    sphere = icosphere(2)
    shift = torch.as_tensor(dx, dtype=F64) * torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    verts = sphere.verts * torch.tensor([1.0, 0.8, 0.9], dtype=F64) + shift
    colors = None if one_colour else torch.rand(verts.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    return eg.Mesh(verts, sphere.faces, colors=colors)


# -- gradients ----------------------------------------------------------------------------------------------------------


def scene(kind: str, dx: Tensor | float = 0.0) -> eg.Scene:
    """boundary: one colour, before an image; interior: a triangle beyond the whole view; both: a sphere before that."""
    background = torch.tensor([0.1, 0.3, 0.2], dtype=F64)
    if kind == "boundary":
        return eg.Scene([colored_sphere(dx, one_colour=True)], background)
    shift = torch.as_tensor(dx, dtype=F64) * torch.tensor([0.0, 1.0, 0.5], dtype=F64)
    corners = torch.tensor([[-19.0, -11.0, 1.5], [19.0, -12.5, 2.5], [1.0, 19.0, 2.0]], dtype=F64) + shift
    colors = torch.tensor([[0.0, 1.0, 0.3], [1.0, 0.2, 0.6], [0.4, 0.5, 1.0]], dtype=F64)
    wall = eg.Mesh(corners, torch.tensor([[0, 1, 2]]), colors=colors)
    return eg.Scene([wall] if kind == "interior" else [colored_sphere(dx), wall], background)


def moved(kind: str, view: eg.Camera, what: str) -> Case:
    """A case in which one number of vertices, pose, K or distortion moves."""

    def vertices(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        return scene(kind, theta), view

    def pose(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        M = view.world_to_camera
        R = rotation((0.0, 0.8, 0.6), theta) @ M[:3, :3]
        t = M[:3, 3] + theta * torch.tensor([0.5, 0.0, 0.2], dtype=F64)
        return scene(kind), view.replace(world_to_camera=torch.cat([torch.cat([R, t[:, None]], 1), M[3:]]))

    def intrinsics(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        change = torch.zeros((3, 3), dtype=F64)
        change[int(what[1]), int(what[2])] = view.size[1] if what[2] != "2" else 0.5 * view.size[1]
        return scene(kind), view.replace(K=view.K + theta * change)

    def distortion(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        change = torch.zeros_like(view.coefficients)
        # Those of a fisheye multiply powers of the angle, 0.7 at the corners: steps that move edges about as far have less noise.
        change[int(what[1:])] = 0.65 ** (-2 * int(what[1:])) if view.lens == "fisheye" else 1.0
        return scene(kind), view.replace(distortion=view.coefficients + theta * change)

    makers: dict[str, Callable[[Tensor], tuple[eg.Scene, eg.Camera]]] = {"vertices": vertices, "pose": pose}
    return makers.get(what) or (intrinsics if what[0] == "K" else distortion)


# Steps move edges by less than a tenth of a pixel, and errors of second order are a thousandth.
STEP = {"vertices": 0.005, "pose": 0.002, "K": 0.002, "d": 0.005}
# Of these the derivative is as small as chance, by symmetry or since terms cancel.
FAINT = 0.02


def check_gradient(
    kind: str, view: eg.Camera, what: str, spp: int = 1024, seeds: int = 4, most_noise: float = 0.01
) -> None:
    case, step = moved(kind, view, what), STEP[what if what in STEP else what[0]]
    fd = finite_difference(case, step, spp, seeds)
    found = gradient(case, 4, sampling=eg.Sampling(surface=50_000, edges=25_000))
    size = gradient_size(case)
    if abs(fd.mean) < FAINT * size:
        assert abs(found.mean - fd.mean) < 0.01 * size
    elif most_noise == 0.01:
        right_ratio(fd, found)
    else:
        noise = math.hypot(fd.error, found.error) / abs(fd.mean)
        assert noise < most_noise, f"{what}: too noisy to decide: {fd}, {found}"
        assert abs(found.mean / fd.mean - 1) <= 0.02 + 3 * noise, f"{what}: finite difference {fd}, gradient {found}"


def gradient_size(case: Case) -> float:
    """Return about |adjoint| · |image| change, the terms that the derivative sums."""
    high, low = (eg.render(*case(torch.tensor(h, dtype=F64)), spp=256, seed=0) for h in (0.01, -0.01))
    return float((high - low).abs().sum()) / 0.02
