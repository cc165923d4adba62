"""The near-field term: gradients by the camera in corners, where nearby surfaces light what is seen."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from both_modes import check_both_modes
from bounce_scenes import QUAD, SCENES, BounceScene, indirect_change, indirect_gradient, mesh
from finite_differences import Case, estimate
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.light import in_kernel, near_field
from edgegrad.points.image_context import ImageContext
from edgegrad.points.records import barycentrics

F64 = torch.float64
ASIDE = torch.tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.6], [0.0, 0.0, 0.0, 0.0], [0.0] * 4], dtype=F64)


def corner() -> BounceScene:
    """A floor and a wall, seen from near, in the light of a point."""
    floor = mesh([[-2, 0, 0], [-2, 0, 2], [2, 0, 2], [2, 0, 0]], QUAD, 0.7)
    wall = mesh([[-2, 0, 0], [2, 0, 0], [2, 2, 0], [-2, 2, 0]], QUAD, 0.8)
    light = eg.lights.PointLight(torch.tensor([0.3, 1.6, 1.7], dtype=F64), torch.tensor([9.0], dtype=F64))
    camera = eg.Camera.look_at((0.4, 1.1, 2.3), (0.0, 0.25, 0.1), (0.4, 1.0, 0.01), 48.5, (32, 32)).to(F64)
    return BounceScene({"floor": floor, "wall": wall}, camera, (light,))


def camera_of(scene: BounceScene, camera: eg.Camera | None = None) -> Case:
    """The camera, of the scene or another one, moves aside."""
    scene = scene if camera is None else scene._replace(camera=camera)

    def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        pose = scene.camera.world_to_camera
        moved = scene.camera.replace(world_to_camera=pose + theta * ASIDE[: len(pose)])
        return eg.Scene(list(scene.meshes.values()), lights=list(scene.lights)), moved

    return case


def test_without_differences_noise_has_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    def noise() -> float:
        found = []
        for seed in range(6):
            theta = torch.zeros((), dtype=F64, requires_grad=True)
            scene, camera = camera_of(corner())(theta)
            counts: dict[str, Any] = {"sampling": eg.Sampling(surface=4_000, edges=1_000)}
            further, direct = (eg.render(scene, camera, 1, seed, bounces=n, **counts).mean() for n in (2, 1))
            found.append(float(torch.autograd.grad(further - direct, theta)[0]))
        return estimate(found).error

    quiet = noise()
    monkeypatch.setattr(near_field, "RADIUS_PX", 0.0)
    assert noise() > 5 * quiet


@pytest.mark.watched
def test_forward_mode_is_the_adjoint_of_reverse_mode() -> None:
    scene, weights = corner(), torch.rand(32, 32, 1, dtype=F64, generator=torch.Generator().manual_seed(0))
    pose = scene.camera.world_to_camera
    tangent = torch.rand(pose.shape, dtype=F64, generator=torch.Generator().manual_seed(1))
    tangent[3:] = 0

    def image(pose: Tensor) -> Tensor:
        moved = scene.camera.replace(world_to_camera=pose)
        lit = eg.Scene(list(scene.meshes.values()), lights=list(scene.lights))
        return eg.render(lit, moved, 1, bounces=2, sampling=eg.Sampling(surface=2_000, edges=1_000), seed=0)

    check_both_modes(image, [pose], [tangent], weights)


COUNTS = {"sampling": eg.Sampling(surface=100_000, edges=100_000)}
# Edges of rooms do not run along rows of pixels: where they come to the next row, all along, the derivative jumps.
ROLLED = eg.Camera.look_at((0.3, 0.35, 3.5), (0.05, -0.1, 0.0), (0.4, 1.0, 0.0), 45.6, (32, 32)).to(F64)


def check(case: Case, h: float) -> None:
    """Within three standard errors of the difference, which are 8 % at most."""
    change, found = indirect_change(case, h, 2048, 8), indirect_gradient(case, h, 8, **COUNTS)
    error = math.hypot(change.error, found.error)
    print(f"{found.mean / change.mean:.4f} ± {error / abs(change.mean):.4f}")
    assert error < 0.08 * abs(change.mean), f"too noisy to decide: {change}, {found}"
    assert abs(found.mean - change.mean) < 3 * error, f"{change}, {found}"


def test_all_light_is_near_or_not() -> None:
    """Values of the near field are whole, and no derivatives by places are left; elsewhere there are no values and all
    derivatives."""
    scene, camera = camera_of(corner())(torch.zeros((), dtype=F64))
    frame = ImageContext(scene, make_request(scene, camera, 1, 0))
    ((_, found),) = frame.sampler.pixel_hits(1 << 20)
    seeds = frame.seeds("inside", len(found.x))

    def light(near: float, only: float = 0.0) -> tuple[Tensor, Tensor]:
        b = barycentrics(found.b).requires_grad_()
        hits = frame.fixed_hits(found.face, b, found.x, seeds)
        hits._near = near
        L = in_kernel.indirect(hits, True, 2, only)
        return L.detach(), torch.autograd.grad(L.sum(), b)[0] if L.requires_grad else torch.zeros_like(b)

    (whole, slope), (tiny, same), (huge, none) = (light(near, near) for near in (0.0, 1e-9, 1e9))
    assert float(whole.max()) > 0.1 and torch.equal(tiny, torch.zeros_like(whole))
    torch.testing.assert_close(huge, whole)
    torch.testing.assert_close(same, slope)
    assert float(none.norm()) < 1e-9 * float(slope.norm())
    some = light(0.5)[1]
    assert float((some - slope).norm()) > 0.0 and float(some.norm()) < float(slope.norm())


@pytest.mark.slow
def test_gradient_in_a_corner() -> None:
    check(camera_of(corner()), 0.2)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["cornell", "standing", "ball"])
def test_gradient_in_rooms(scene: str) -> None:
    check(camera_of(SCENES[scene][0](), ROLLED), 0.15)


@pytest.mark.slow
def test_a_wider_filter_has_the_same_slope() -> None:
    """Compare the slope of the mean of an image, which agrees within a quarter of a pixel."""
    scene, camera = camera_of(corner())(torch.zeros((), dtype=F64))
    slopes: dict[str, list[float]] = {"box": [], "tent": []}
    for seed in range(24):
        for filter, found in slopes.items():
            theta = torch.zeros((), dtype=F64, requires_grad=True)
            moved = camera.replace(
                world_to_camera=camera.world_to_camera + theta * ASIDE[: len(camera.world_to_camera)]
            )
            options: dict[str, Any] = {"filter": filter, "sampling": eg.Sampling(surface=60_000, edges=320_000)}
            image = eg.render(scene, moved, 1, seed, bounces=2, **options)
            found.append(float(torch.autograd.grad(image.mean(), theta)[0]))
    a, b = (estimate(found) for found in slopes.values())
    error = math.hypot(a.error, b.error)
    print(a, b)
    assert error < 0.012 * abs(a.mean) and abs(a.mean - b.mean) < 3 * error
