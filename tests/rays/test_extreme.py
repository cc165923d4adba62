"""Extreme numbers and degenerate topology: what is right, what is refused, and that nothing takes for ever."""

from __future__ import annotations

import math
import signal
import time

import extreme_scenes
import pytest
import torch
from kernel_parts import parts
from scenes import front_camera, icosphere, smooth_adjoint
from torch import Tensor

import edgegrad as eg
from edgegrad.library import core

F32, F64 = torch.float32, torch.float64


@pytest.mark.parametrize("part", range(4))
def test_random_scenes(part: int):
    assert extreme_scenes.main(25 * part, 25) == 0


@pytest.mark.slow
@pytest.mark.parametrize("part", range(20))
def test_many_random_scenes(part: int):
    assert extreme_scenes.main(1000 + 500 * part, 500) == 0


# -- far vertices and mixed precision ---------------------------------------------------------------------------------


def image_and_gradient(mesh: eg.Mesh, camera: eg.Camera, *others: eg.Mesh, seed: int = 0) -> tuple[Tensor, Tensor]:
    verts = mesh.verts.clone().requires_grad_()
    image = eg.render(eg.Scene([mesh.replace(verts=verts), *others]), camera, seed=seed)
    adjoint = smooth_adjoint(*camera.size, 3).to(image.dtype)
    return image.detach(), torch.autograd.grad(image, verts, adjoint)[0]


@pytest.mark.parametrize("far", [1e15, 1e38])
def test_a_vertex_without_faces_changes_nothing(far: float):
    ball = icosphere(2).transformed(scale=0.8)
    more = ball.replace(
        verts=torch.cat([ball.verts, torch.tensor([[far, 0.0, -far]], dtype=F64)]),
        colors=torch.cat([ball.colors, torch.zeros(1, 3, dtype=F64)]),
    )
    image, gradient = image_and_gradient(ball, front_camera(32))
    image_more, gradient_more = image_and_gradient(more, front_camera(32))
    assert torch.equal(image_more, image)
    assert torch.equal(gradient_more[:-1], gradient) and not bool(gradient_more[-1].any())


def sky(distance: float) -> eg.Mesh:
    """A triangle that fills much of the view of front_camera, so far away, as large as that."""
    camera = front_camera(32)
    corners = distance * torch.tensor([[-1.0, -1.2, 1.0], [1.3, -0.9, 1.1], [0.1, 0.35, 1.05]], dtype=F64)
    pose = camera.world_to_camera
    verts = (corners - pose[:3, 3]) @ pose[:3, :3]
    return eg.Mesh(
        verts, torch.tensor([[0, 1, 2]]), colors=torch.tensor([[0.9, 0.1, 0.2], [0, 1, 0], [0, 0, 1]], dtype=F64)
    )


def test_a_face_very_far_behind():
    """It looks the same from 1e12 on, to 1e20 times the size of what lies before it."""
    ball = icosphere(2).transformed(scale=0.8)
    image, gradient = image_and_gradient(ball, front_camera(32), sky(1e6))
    for distance in (1e14, 1e20):
        image_far, gradient_far = image_and_gradient(ball, front_camera(32), sky(distance))
        assert float((image_far - image).abs().max()) < 1e-4
        assert float((gradient_far - gradient).norm()) < 1e-3 * float(gradient.norm())


@pytest.mark.parametrize("action", [eg.render, eg.plan])
def test_what_floats_cannot_hold_together_is_refused(action):
    scene = eg.Scene([icosphere(2), sky(1e30)])
    with pytest.raises(
        ValueError, match=r"^verts: expected faces within 1e21 times their size of each other, got .*1\.\de\+30"
    ):
        action(scene, front_camera(8))


def test_one_float32_mesh_leaves_the_others_their_precision():
    """At 1e6 the spacing of float32 is 0.1: a ball of radius 0.8 in float64 must not be welded as coarsely as that."""
    shift = 1e6 * torch.tensor([1.0, -1.0, 0.5], dtype=F64)
    camera = front_camera(32)
    pose = camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ shift
    camera = camera.replace(world_to_camera=pose)
    ball = icosphere(2)
    open_ball = ball.faces[ball.verts[ball.faces].mean(1)[:, 0] > -0.2]
    half = eg.Mesh(0.8 * ball.verts + shift, open_ball, colors=ball.colors)
    corners = torch.tensor([[0.9, 0.9, 0.0], [1.1, 0.9, 0.0], [1.0, 1.1, 0.0]], dtype=F64) + shift
    triangle = eg.Mesh(
        corners.to(F32), torch.tensor([[0, 1, 2]]), face_colors=torch.tensor([[0.1, 0.2, 0.3]], dtype=F64)
    )
    same = triangle.replace(verts=triangle.verts.double())
    gradients = [
        torch.stack([image_and_gradient(half, camera, other, seed=s)[1].sum(0) for s in range(4)]).mean(0)
        for other in (triangle, same)
    ]
    assert float((gradients[0] - gradients[1]).norm()) < 0.01 * float(gradients[1].norm())


def test_copies_weld_at_the_spacing_of_the_coarser_one():
    """Two triangles with a side in common, off by a rounding of float32, of which one or both are float64 numbers."""
    a = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=F64)
    b = torch.tensor([[1.0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=F64) * (1 + 2.0**-23)
    verts, faces = torch.cat([a, b]).numpy(), torch.arange(6, dtype=torch.int32).reshape(2, 3).numpy()
    for spacing, edges in (([2.0**-23, 2.0**-52], 5), ([2.0**-52, 2.0**-23], 5), ([2.0**-52, 2.0**-52], 6)):
        assert len(parts.edges(verts, faces, [0, 3], spacing)) == edges


def test_an_orthographic_eye_very_far_away():
    """The view is the same from any distance."""
    ball = icosphere(2)
    ball = ball.replace(
        colors=None, face_colors=torch.rand(len(ball.faces), 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    )
    direction = torch.tensor([0.31, 0.53, 0.77], dtype=F64)

    def gradient(distance: float) -> Tensor:
        eye = direction / direction.norm() * distance
        return image_and_gradient(
            ball, eg.Camera.orthographic(eye, (0.0, 0.0, 0.0), height=2.5, size=(24, 24)).to(F64)
        )[1]

    near = gradient(3.0)
    assert float((gradient(1e8) - near).norm()) < 1e-6 * float(near.norm())
    # There the camera's own numbers, in double, are off by 1e-6, which moves samples from one face to another.
    for distance in (1e10, 1e12):
        assert float((gradient(distance) - near).norm()) < 0.05 * float(near.norm())


# -- degenerate topology ----------------------------------------------------------------------------------------------


def seconds_of_edges(verts: Tensor) -> float:
    """Return the seconds of processor time to find the edges of a soup."""
    faces = torch.arange(len(verts), dtype=torch.int32).reshape(-1, 3).numpy()
    begin = time.process_time()
    parts.edges(verts.numpy(), faces, [0], [2.0**-52])
    return time.process_time() - begin


def fan(n: int) -> Tensor:
    """A disc of n triangles, as a soup."""
    a = torch.linspace(0, 2 * math.pi, n + 1, dtype=F64)
    ring = torch.stack([a.cos(), a.sin(), 0 * a], -1)
    return torch.stack([torch.zeros(n, 3, dtype=F64), ring[:-1], ring[1:]], 1).reshape(-1, 3)


@pytest.mark.parametrize(
    "soup",
    [
        fan,
        lambda n: torch.full((3 * n, 3), 0.1, dtype=F64),
        # All distinct, and all within reach of the first.
        lambda n: (
            1.0 + 2.0**-51 * torch.randint(-2, 3, (3 * n, 3), generator=torch.Generator().manual_seed(0)).double()
        ),
        lambda n: (
            torch.tensor([[1e9, 0.0, 0.0]], dtype=F64)
            + 1e-8 * torch.rand(3 * n, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
        ),
    ],
    ids=["fan", "point", "lattice", "cloud"],
)
def test_welding_takes_a_linear_time(soup):
    seconds_of_edges(soup(1000))
    few, many = (min(seconds_of_edges(soup(n)) for _ in range(3)) for n in (4000, 32000))
    assert many < 24 * few + 0.3  # 8 times as many; the square would be 64, and seconds


def cone(n: int) -> eg.Mesh:
    """Return a cone around −z with its tip in the origin."""
    a = torch.linspace(0, 2 * math.pi, n + 1, dtype=F64)[:-1]
    verts = torch.cat(
        [torch.zeros(1, 3, dtype=F64), torch.stack([0.3 * a.cos(), 0.3 * a.sin(), -torch.ones_like(a)], -1)]
    )
    i = torch.arange(n)
    return eg.Mesh(verts, torch.stack([0 * i, 1 + i, 1 + (i + 1) % n], -1))


def test_the_eye_on_a_vertex_of_many_faces():
    """None of them is seen, and what lies behind them is."""
    wall = eg.Mesh(
        torch.tensor([[-9.0, -9, -2], [9, -9, -2], [0, 18, -2]], dtype=F64), torch.tensor([[0, 1, 2]]),
        colors=torch.eye(3, dtype=F64),
    )  # fmt: skip
    camera = eg.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov_y=60.0, size=(16, 16)).to(F64)
    image, gradient = image_and_gradient(wall, camera)
    begin = time.process_time()
    seen_through, gradient_through = image_and_gradient(wall, camera, cone(1024))
    seconds = time.process_time() - begin
    torch.testing.assert_close(seen_through, image)
    assert float((gradient_through - gradient).norm()) < 0.05 * float(gradient.norm())
    aside = eg.Camera.look_at((1e-6, 0.0, 0.0), (1e-6, 0.0, -1.0), fov_y=60.0, size=(16, 16)).to(F64)
    begin = time.process_time()
    image_and_gradient(wall, aside, cone(1024))
    assert seconds < 30 * (time.process_time() - begin)  # one ray a face: hundreds of times as long


@pytest.mark.parametrize("size", [1e18, 1e25])
def test_samples_of_a_triangle_that_reaches_very_far(size: float):
    """Its corners in the view come from those far away, by differences of which nothing is left."""
    camera = eg.Camera.orthographic((0.1, 0.2, 3.0), (0.0, 0.0, 0.0), size=(32, 32)).to(F64)
    for seed in range(10):
        turn = torch.linalg.qr(torch.randn(3, 3, dtype=F64, generator=torch.Generator().manual_seed(seed)))[0]
        corners = torch.tensor([[-1.3, -0.7, 0.2], [1.1, -0.9, -0.3], [0.3, 1.2, 0.4]], dtype=F64) @ turn
        verts = (size * corners).requires_grad_()
        scene = eg.Scene(eg.Mesh(verts, torch.tensor([[0, 1, 2]]), colors=torch.eye(3, dtype=F64)))
        plan = eg.plan(scene, camera)
        assert plan["interior"].samples + plan["boundary"].samples <= extreme_scenes.most_samples(scene, camera)


# -- Ctrl-C -----------------------------------------------------------------------------------------------------------


class Stopped(Exception):
    pass


@pytest.mark.parametrize(
    "soup", [pytest.param(False, id="grid", marks=pytest.mark.slow), pytest.param(True, id="soup")]
)
def test_a_signal_handler_stops_the_making_of_geometry(soup: bool):
    """At whatever point of it, in less than a fifth of the time that it takes; and what is rendered next is right."""
    n = 200 if soup else 300
    x, y = torch.meshgrid(torch.linspace(-1, 1, n + 1), torch.linspace(-1, 1, n + 1), indexing="ij")
    verts = torch.stack([x, y, 0.1 * torch.sin(9 * x)], -1).reshape(-1, 3)
    i = torch.arange(n * (n + 1)).reshape(n, n + 1)[:, :-1].reshape(-1)
    faces = torch.cat([torch.stack([i, i + 1, i + n + 1], -1), torch.stack([i + 1, i + n + 2, i + n + 1], -1)])
    if soup:
        verts, faces = verts[faces].reshape(-1, 3), torch.arange(3 * len(faces)).reshape(-1, 3)
    camera = front_camera(16)

    def step() -> Tensor:
        core.clear_geometry()
        leaf = verts.clone().requires_grad_()
        eg.render(eg.Mesh(leaf, faces), camera, spp=1, seed=0).sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    def stop(*_: object) -> None:
        raise Stopped

    step()
    begin = time.process_time()
    expected = step()
    whole = time.process_time() - begin
    before = signal.signal(signal.SIGPROF, stop)
    try:
        for share in (0.2, 0.4, 0.6, 0.8):
            signal.setitimer(signal.ITIMER_PROF, share * whole)
            begin = time.process_time()
            try:
                step()
            except Stopped:
                assert time.process_time() - begin < share * whole + 0.2 * whole + 0.3
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
    finally:
        signal.signal(signal.SIGPROF, before)
    assert torch.equal(step(), expected)
