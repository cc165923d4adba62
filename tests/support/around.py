"""Scenes around a camera, what is seen of them through any lens, and how it moves: for the tests of lenses."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from finite_differences import Case, finite_difference, gradient, rotation
from kernel_parts import parts
from scenes import cube, icosphere
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
Place = tuple[float, float, float]  # before the camera at pose(), in its coordinates
BACKGROUND = torch.tensor([0.1, 0.3, 0.2], dtype=F64)


def check_boxes(sub_camera: object, shown_whole: bool) -> None:
    """Places in boxes of a sub-camera's plane are seen in the boxes of the image that the kernel says; all of them, or those that
    are shown."""
    rng = np.random.default_rng(1)
    box = np.array(parts.view_box(sub_camera))
    for _ in range(30):
        low, high = np.sort(rng.uniform(box[0], box[1], (2, 2)), 0)
        image_low, image_high = (np.array(p) for p in parts.image_box(sub_camera, low, high))
        for u in rng.uniform(low, high, (20, 2)):
            x, area_scale, _ = parts.distort(sub_camera, u, [0.0, 0.0])
            assert area_scale > 0 or not shown_whole
            if area_scale > 0:
                assert (np.array(x) >= image_low - 1e-9).all() and (np.array(x) <= image_high + 1e-9).all()


def pose() -> Tensor:
    M = torch.eye(4, dtype=F64)
    M[:3, :3] = rotation((0.0, 0.6, 0.8), torch.tensor(0.4, dtype=F64))
    M[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    return M


def world(q: Tensor) -> Tensor:
    """Return points in the world from their coordinates in the camera at pose()."""
    M = pose()
    return (q - M[:3, 3]) @ M[:3, :3]


def ball(place: Place, radius: float = 1.0, one_colour: bool = False) -> eg.Mesh:
    """At a place before the camera, in the world."""
    sphere = icosphere(1)
    verts = sphere.verts * torch.tensor([1.0, 0.8, 0.9], dtype=F64) * radius + torch.tensor(place, dtype=F64)
    colors = torch.rand(verts.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    return eg.Mesh(world(verts), sphere.faces, colors=torch.ones_like(verts) if one_colour else colors)


def room(dx: Tensor | float = 0.0) -> eg.Mesh:
    """Return a room of few large faces around the camera, moved askew by dx."""
    box = cube(4.0)
    verts = box.verts @ rotation((0.6, 0.0, 0.8), torch.tensor(0.7, dtype=F64)).mT
    colors = torch.rand(verts.shape, generator=torch.Generator().manual_seed(2), dtype=F64)
    return eg.Mesh(
        verts + torch.as_tensor(dx, dtype=F64) * torch.tensor([0.5, 1.0, 0.7], dtype=F64), box.faces, colors=colors
    )


# -- images and areas -----------------------------------------------------------------------------------------------------


def traced(scene: eg.Scene, view: eg.Camera, grid: int, directions: Callable[[np.ndarray], np.ndarray]) -> Tensor:
    """The image of vertex colours from grid × grid rays a pixel, in double: Möller and Trumbore 1997. `directions` are those in
    the world of what is seen at pixel positions (N, 2); not numbers where nothing is."""
    H, W = view.size
    x, y = ((np.arange(n * grid) + 0.5) / grid for n in (W, H))
    d = directions(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    M = view.world_to_camera.numpy()
    eye = -M[:3, :3].T @ M[:3, 3]
    radiance, nearest = np.tile(BACKGROUND.numpy(), (len(d), 1)), np.full(len(d), np.inf)
    for mesh in scene.meshes:
        assert mesh.colors is not None
        for face in mesh.faces.tolist():
            (a, b, c), colors = mesh.verts[face].numpy(), mesh.colors[face].numpy()
            e1, e2, s = b - a, c - a, eye - a
            p, q = np.cross(d, e2), np.cross(s, e1)
            det = p @ e1
            u, v, t = p @ s / det, d @ q / det, (e2 @ q) / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < nearest)
            nearest[hit] = t[hit]
            radiance[hit] = np.stack([1 - u - v, u, v], -1)[hit] @ colors
    return torch.from_numpy(radiance).reshape(H, grid, W, grid, 3).mean((1, 3))


def area(view: eg.Camera, corners: Tensor) -> Tensor:
    """Pixels that a triangle covers: its sides distorted point by point, chord by chord. Differentiable."""
    steps = torch.linspace(0, 1, 4001, dtype=F64)[:-1, None]
    sides = [(1 - steps) * corners[i] + steps * corners[(i + 1) % 3] for i in range(3)]
    outline = view.project(torch.cat(sides))
    H, W = view.size
    assert bool(((outline > 0) & (outline < torch.tensor([W, H]))).all()), "it must lie within the image"
    x, y = outline.unbind(-1)
    return 0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum().abs()


def check_area(view: eg.Camera, corners: Tensor) -> None:
    """The image of a white triangle before black, summed: the area, and its derivative in everything that moves it."""
    leaves = [t.clone().requires_grad_() for t in (corners, view.world_to_camera, view.K, view.coefficients)]
    corners, M, K, d = leaves
    white = eg.Mesh(corners, torch.tensor([[0, 1, 2]]), colors=torch.ones((3, 1), dtype=F64))
    view = view.replace(world_to_camera=M, K=K, distortion=d)
    expected = area(view, corners)
    image = eg.render(
        eg.Scene([white], torch.zeros(1, dtype=F64)), view, 1024, sampling=eg.Sampling(edges=200_000), seed=0
    )
    assert float(image.detach().sum()) == pytest.approx(float(expected.detach()), rel=1e-3)
    truth, found = (torch.autograd.grad(value, leaves) for value in (expected, image.sum()))
    for name, a, b in zip(("corners", "world_to_camera", "K", "distortion"), truth, found, strict=True):
        # Samples lie evenly on the sides: their error falls as 1 / n.
        torch.testing.assert_close(b, a, rtol=2e-3, atol=1e-3 * float(a.abs().max()), msg=lambda m, n=name: f"{n}: {m}")


# -- gradients -------------------------------------------------------------------------------------------------------------


def boundary(place: Place, dx: Tensor | float = 0.0) -> eg.Scene:
    one = ball(place, one_colour=True)
    shift = torch.as_tensor(dx, dtype=F64) * torch.tensor([1.0, 0.4, 0.6], dtype=F64)
    return eg.Scene([one.replace(verts=one.verts + shift)], BACKGROUND)


def both(place: Place, dx: Tensor | float = 0.0) -> eg.Scene:
    one = ball(place)
    shift = torch.as_tensor(dx, dtype=F64) * torch.tensor([1.0, 0.4, 0.6], dtype=F64)
    return eg.Scene([one.replace(verts=one.verts + shift), room(dx)], BACKGROUND)


def moved(scene: Callable[..., eg.Scene], view: eg.Camera, what: str) -> Case:
    """A case in which one number of vertices, pose, K or distortion moves."""

    def vertices(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        return scene(dx=theta), view

    def turned(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        M = view.world_to_camera
        R = rotation((0.48, 0.6, 0.64), theta)
        return scene(), view.replace(world_to_camera=torch.cat([R @ M[:3], M[3:]]))

    def shifted(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        M = view.world_to_camera
        t = M[:3, 3:] + theta * torch.tensor([[0.8], [0.3], [0.5]], dtype=F64)
        return scene(), view.replace(world_to_camera=torch.cat([torch.cat([M[:3, :3], t], 1), M[3:]]))

    def intrinsics(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        change = torch.zeros((3, 3), dtype=F64)
        change[int(what[1]), int(what[2])] = 4.0 if what[2] != "2" else 8.0
        return scene(), view.replace(K=view.K + theta * change)

    def distortion(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        # Of a wide fisheye, at about 125°.
        change = torch.zeros(4, dtype=F64)
        change[int(what[1])] = 0.25 * 2.2 ** (-2 * int(what[1]) - 2)
        return scene(), view.replace(distortion=view.coefficients + theta * change)

    makers = {"vertices": vertices, "turn": turned, "shift": shifted}
    return makers.get(what) or (intrinsics if what[0] == "K" else distortion)


# Of these the derivative is as small as chance, by symmetry or since terms cancel.
FAINT = 0.02


def check_gradient(case: Case, spp: int = 2048, seeds: int = 4, step: float = 0.005, filter: str = "box") -> None:
    fd = finite_difference(case, step, spp, seeds, filter=filter)
    found = gradient(case, 4, sampling=eg.Sampling(surface=100 * spp, edges=50_000), filter=filter)
    high, low = (eg.render(*case(torch.tensor(h, dtype=F64)), spp=256, seed=0) for h in (0.01, -0.01))
    size = float((high - low).abs().sum()) / 0.02
    assert size > 0, "nothing that moves is in view"
    noise = math.hypot(fd.error, found.error)
    if abs(fd.mean) < FAINT * size:
        assert abs(found.mean - fd.mean) < 0.01 * size + 4 * noise
        return
    # No more than 4 %, so that a gradient that is 5 % off does not pass.
    assert noise < 0.015 * abs(fd.mean), f"too noisy to decide: {fd}, {found}"
    assert abs(found.mean - fd.mean) <= 0.01 * abs(fd.mean) + 2 * noise, f"finite difference {fd}, gradient {found}"
