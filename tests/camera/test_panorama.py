"""Panoramas: places against the formula, images against rays traced in double, gradients against finite differences; before the
camera, behind it across the seam, and around the poles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from around import BACKGROUND, ball, both, boundary, check_boxes, check_gradient, moved, pose, room, traced, world
from finite_differences import finite_difference, gradient, right_ratio, rotation
from kernel_parts import parts
from scenes import cube
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.operators import kernel_camera, pass_size
from edgegrad.kernel.request import make_request, pack_camera
from edgegrad.library import core

F64 = torch.float64
SIZE = (24, 48)
# Where things are: before the camera, behind it, below and above.
PLACES = {"ahead": (0.9, 0.7, 2.0), "seam": (0.2, -0.4, -2.5), "pole": (0.4, 2.5, -0.3), "above": (-0.2, -2.4, 0.5)}
places = pytest.mark.parametrize("place", PLACES)


def camera(size: tuple[int, int] = SIZE, skew: float = 0.0) -> eg.Camera:
    view = eg.Camera.panorama(pose(), size)
    return view.replace(K=view.K + torch.tensor([[0, skew, 0], [0.5 * skew, 0, 0], [0, 0, 0]], dtype=F64))


CAMERAS = {
    "whole": camera(),
    "skewed": camera(skew=1.5),
    "mirrored": camera().replace(K=camera().K * torch.tensor([[-1.0, 1, 1], [1, 1, 1], [1, 1, 1]], dtype=F64)),
    "crop": camera((96, 192)).crop(60, -20, 48, 60),  # over the seam, and over the pole
    "several turns": camera((12, 24)).crop(-15, -30, 42, 70),
}
cameras = pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS.keys())


# -- positions ----------------------------------------------------------------------------------------------------------


def direction(angles: np.ndarray) -> np.ndarray:
    longitude, latitude = angles[..., 0], angles[..., 1]
    c = np.cos(latitude)
    return np.stack([c * np.sin(longitude), np.sin(latitude), c * np.cos(longitude)], -1)


def directions(view: eg.Camera, x: np.ndarray) -> np.ndarray:
    """Return the directions in the world of what is seen at pixel positions (…, 2)."""
    K, R = view.K.numpy(), view.world_to_camera[:3, :3].numpy()
    return direction(np.linalg.solve(K[:2, :2], (x - K[:2, 2])[..., None])[..., 0]) @ R


def sub_cameras(view: eg.Camera, reach: float = 0.0) -> list:
    return parts.sub_cameras(kernel_camera(pack_camera(view)), reach)


def seen_through(sub_camera, turn: list, q: np.ndarray) -> np.ndarray | None:
    """Return where a sub-camera shows a point in camera coordinates, or None."""
    x, y, z = np.array(turn) @ q
    if z <= 0 or max(abs(x), abs(y)) > z:
        return None
    low, high = parts.view_box(sub_camera)
    scale = np.abs(parts.project_straight(sub_camera, [1.0, 1.0, 1.0]))
    u = parts.project_straight(sub_camera, [x, y, z])
    slack = 1e-9 * scale
    if (np.array(u) < np.array(low) - slack).any() or (np.array(u) > np.array(high) + slack).any():
        return None
    return np.array(parts.project(sub_camera, [x, y, z]))


@cameras
def test_points_agree_with_the_formula(view: eg.Camera) -> None:
    """Every place of a direction in the image is found, and once."""
    rng = np.random.default_rng(0)
    K, (H, W) = view.K.numpy(), view.size
    through = sub_cameras(view)
    count = 0
    for q in rng.normal(size=(100, 3)):
        longitude, latitude = math.atan2(q[0], q[2]), math.asin(q[1] / np.linalg.norm(q))
        p = world(torch.from_numpy(q))
        expected = K[:2, :2] @ [longitude, latitude] + K[:2, 2]
        np.testing.assert_allclose(view.project(p).numpy(), expected, atol=1e-9)
        all_places = [
            K[:2, :2] @ [longitude + j * math.pi, i * math.pi + (-1) ** i * latitude] + K[:2, 2]
            for i in range(-5, 6)
            for j in range(-11, 12)
            if (i + j) % 2 == 0
        ]
        inside = sorted(tuple(x) for x in all_places if 0 < x[0] < W and 0 < x[1] < H)
        found = [seen_through(sub_camera, turn, q) for sub_camera, turn in through]
        found = sorted(tuple(x) for x in found if x is not None and 0 < x[0] < W and 0 < x[1] < H)
        assert len(found) == len(inside)
        if inside:
            np.testing.assert_allclose(found, inside, atol=1e-9)
        count += len(inside)
    assert count > 10


@cameras
def test_every_pixel_position_belongs_to_one_sub_camera(view: eg.Camera) -> None:
    """This holds on the borders between them, too, as at 45°, and at the image's border."""
    H, W = view.size
    x = [
        *np.random.default_rng(0).uniform((0, 0), (W, H), (300, 2)),
        *np.mgrid[0 : W + 1 : 3, 0 : H + 1 : 3].reshape(2, -1).T,
    ]
    through = [sub_camera for sub_camera, _ in sub_cameras(view)]
    for place in x:
        found = [np.array(parts.normalised(sub_camera, place)) for sub_camera in through]
        assert sum(np.isfinite(n).all() for n in found) == 1


@cameras
def test_boxes_hold_what_they_say(view: eg.Camera) -> None:
    for sub_camera, _ in sub_cameras(view):
        check_boxes(sub_camera, shown_whole=True)


def test_position_gradient() -> None:
    view = camera(skew=1.5)
    points = torch.stack([world(torch.tensor(q, dtype=F64)) for q in PLACES.values()])

    def positions(R: Tensor, K: Tensor) -> Tensor:
        turn = torch.linalg.matrix_exp(torch.linalg.cross(R.expand(3, 3), torch.eye(3, dtype=F64)))
        M = torch.cat([torch.cat([turn, R[:, None]], 1) @ view.world_to_camera, view.world_to_camera[3:]])
        return view.replace(world_to_camera=M, K=torch.cat([K[:2], view.K[2:]])).project(points)

    leaves = torch.full((3,), 0.1, dtype=F64, requires_grad=True), view.K.clone().requires_grad_()
    assert torch.autograd.gradcheck(positions, leaves)


# -- images -------------------------------------------------------------------------------------------------------------


def balls() -> list[eg.Mesh]:
    return [ball(place) for place in PLACES.values()]


@cameras
def test_image_against_traced_rays(view: eg.Camera) -> None:
    scene = eg.Scene([*balls(), room()], BACKGROUND)
    expected, image = traced(scene, view, 3, lambda x: directions(view, x)), eg.render(scene, view, 256, seed=0)
    # The border of a face may pass anywhere between the rays of the grid.
    assert float((image - expected).abs().mean()) < 0.01
    assert float((image - expected).abs().max()) < 0.3


def test_turning_the_camera_shifts_the_image() -> None:
    """The shift is by whole pixels. Nothing is special about the seam, also where a filter reaches over it."""
    scene, view = eg.Scene([*balls(), room()], BACKGROUND), camera()
    for filter in ("box", "tent"):
        image = eg.render(scene, view, 256, filter=filter, seed=0)
        for pixels in (7, 25):
            M = view.world_to_camera.clone()
            M[:3] = rotation((0.0, 1.0, 0.0), torch.tensor(math.tau * pixels / view.size[1], dtype=F64)) @ M[:3]
            turned = eg.render(scene, view.replace(world_to_camera=M), 256, seed=1, filter=filter)
            difference = turned - image.roll(pixels, 1)
            assert float(difference.abs().mean()) < 2e-3 and float(difference.abs().max()) < 0.05


def test_more_than_one_turn() -> None:
    """The image repeats, and over the poles it is turned by 180° and upside down."""
    scene, view = eg.Scene(balls(), BACKGROUND), camera()
    H, W = view.size
    once, more = eg.render(scene, view, 512, seed=0), eg.render(scene, view.crop(-H, -W, 3 * H, 3 * W), 512, seed=1)
    over = once.roll(W // 2, 1).flip(0)
    expected = torch.cat([torch.cat([part] * 3, 1) for part in (over, once, over)])
    assert float((more - expected).abs().mean()) < 2e-3 and float((more - expected).abs().max()) < 0.06


# -- areas --------------------------------------------------------------------------------------------------------------

TRIANGLES = {
    "ahead": [[-0.6, -0.5, 1.3], [0.8, -0.2, 1.6], [-0.1, 0.7, 1.2]],
    "aside": [[1.3, -0.5, -0.6], [1.6, -0.2, 0.8], [1.2, 0.7, -0.1]],
    "seam": [[-0.6, -0.5, -1.3], [0.8, -0.2, -1.6], [-0.1, 0.7, -1.2]],
    "pole": [[-0.6, 1.3, -0.5], [0.8, 1.6, -0.2], [-0.1, 1.2, 0.7]],
    "above": [[-0.6, -1.3, -0.5], [0.8, -1.6, -0.2], [-0.1, -1.2, 0.7]],
    "next to a pole": [[0.1, 1.3, 0.12], [0.8, 1.6, 0.2], [0.3, 1.2, 0.7]],
    "huge": [[-9.0, -8.0, 0.4], [30.0, 0.5, 0.3], [-9.0, 20.0, 0.5]],
}


def area(view: eg.Camera, corners: Tensor) -> Tensor:
    """Pixels that a triangle covers: −∮ (φ − φ₀) dλ around its outline, chord by chord, in any number of turns; φ₀ is the
    latitude of the pole that it holds. Differentiable."""
    steps = torch.linspace(0, 1, 20_001, dtype=F64)[:-1, None]
    outline = torch.cat([(1 - steps) * corners[i] + steps * corners[(i + 1) % 3] for i in range(3)])
    K = view.K
    angles = torch.linalg.solve(K[:2, :2], (view.project(outline) - K[:2, 2]).mT).mT
    longitude, latitude = angles.unbind(-1)
    step = longitude.roll(-1) - longitude
    step = step - math.tau * (step / math.tau).round().detach()
    pole = 0.0 if abs(float(step.detach().sum())) < 1 else math.copysign(math.pi / 2, float(latitude.detach().mean()))
    return ((0.5 * (latitude + latitude.roll(-1)) - pole) * step).sum().abs() * torch.linalg.det(K[:2, :2]).abs()


@pytest.mark.parametrize(
    ("place", "shift"),
    [
        pytest.param(place, shift, marks=[] if place == "huge" or k % 2 == (shift > 0) else [pytest.mark.slow])
        for k, place in enumerate(TRIANGLES)
        for shift in (0, 30)
    ],
)
def test_area_of_a_triangle(place: str, shift: int) -> None:
    """The image of a white triangle before black, summed: the area, and its derivative in everything that moves it. All of the
    sphere is in view; K moves none of it through the borders, for beyond them the panorama goes on."""
    view = camera().crop(0, shift, *SIZE)
    leaves = [
        t.clone().requires_grad_() for t in (world(torch.tensor(TRIANGLES[place], dtype=F64)), view.world_to_camera)
    ]
    corners, M = leaves
    white = eg.Mesh(corners, torch.tensor([[0, 1, 2]]), colors=torch.ones((3, 1), dtype=F64))
    view = view.replace(world_to_camera=M)
    expected = area(view, corners)
    image = eg.render(
        eg.Scene([white], torch.zeros(1, dtype=F64)), view, 1024, sampling=eg.Sampling(edges=200_000), seed=0
    )
    assert float(image.detach().sum()) == pytest.approx(float(expected.detach()), rel=2e-3)
    truth, found = (torch.autograd.grad(value, leaves) for value in (expected, image.sum()))
    for name, a, b in zip(("corners", "world_to_camera"), truth, found, strict=True):
        torch.testing.assert_close(b, a, rtol=5e-3, atol=2e-3 * float(a.abs().max()), msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("place", ["ahead", "aside"])
def test_area_by_intrinsics(place: str) -> None:
    view = camera(skew=1.5)
    K = view.K.clone().requires_grad_()
    corners = world(torch.tensor(TRIANGLES[place], dtype=F64))
    white = eg.Mesh(corners, torch.tensor([[0, 1, 2]]), colors=torch.ones((3, 1), dtype=F64))
    view = view.replace(K=K)
    image = eg.render(
        eg.Scene([white], torch.zeros(1, dtype=F64)), view, 16, sampling=eg.Sampling(edges=200_000), seed=0
    )
    (expected,), (found,) = (torch.autograd.grad(value, K) for value in (area(view, corners), image.sum()))
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=2e-3 * float(expected.abs().max()))


# -- gradients ----------------------------------------------------------------------------------------------------------


WHAT = ["vertices", "turn", "shift", "K00", "K01", "K02", "K10", "K11", "K12"]


@pytest.mark.parametrize(
    ("place", "what"),
    [
        ("seam", "vertices"),
        ("pole", "turn"),
        pytest.param("ahead", "turn", marks=pytest.mark.slow),
        pytest.param("above", "K11", marks=pytest.mark.slow),
    ],
)
def test_gradient(place: str, what: str) -> None:
    check_gradient(
        moved(lambda dx=0.0: both(PLACES[place], dx), camera(), what), spp=2048 if place == "pole" else 1024, seeds=3
    )


VIEWS = ["whole", "skewed", "crop", "several turns"]
# One in seven of all: each place with each view, and each derivative with all of both. The crop shows but one of the balls.
SOME = [
    (place, kind, view, what)
    for place, kind, view, what in list(itertools.product(PLACES, [boundary, both], VIEWS, WHAT))[::7]
    if view != "crop" or kind is both or place == "pole"
]


@pytest.mark.slow
@pytest.mark.parametrize(("place", "kind", "view", "what"), SOME)
def test_gradients(place: str, kind: Callable[..., eg.Scene], view: str, what: str) -> None:
    """The filter makes the loss smooth: a box filter has kinks where edges pass the borders of pixels, and small steps have
    noise."""
    # Ball and room move together, so that terms nearly cancel, and what is left changes over longer steps.
    step = 0.01 if what == "vertices" else 0.02
    check_gradient(
        moved(lambda dx=0.0: kind(PLACES[place], dx), CAMERAS[view], what), spp=4096, seeds=6, step=step, filter="tent"
    )


@pytest.mark.parametrize("what", ["vertices", pytest.param("K00", marks=pytest.mark.slow)])
def test_gradient_of_the_room_alone(what: str) -> None:
    """All that is seen is one surface of few large faces: over the seam, and over both poles."""
    check_gradient(moved(lambda dx=0.0: eg.Scene([room(dx)], BACKGROUND), camera(), what), spp=256)


@pytest.mark.parametrize("filter", ["box", pytest.param("gaussian", marks=pytest.mark.slow)])
def test_edges_between_sub_cameras_count_once(filter: str) -> None:
    """An upright square room around the eye: its edges run exactly where the frames of the panorama meet, and its corners lie in
    three of them. Each side has one colour, so the diagonals that run through the poles are no edges."""
    box = cube(2.0)
    a, b, c = box.verts[box.faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    face_colors = torch.sin(normal @ torch.tensor([[0.9, 0.2, 0.4], [0.3, 1.1, 0.7], [1.3, 0.5, 0.8]], dtype=F64)) ** 2
    view = eg.Camera.panorama(torch.eye(4, dtype=F64), SIZE)
    # Off the borders of pixels, where with a box filter the gradient would be another on either side.
    view = view.replace(K=view.K + torch.tensor([[0, 0, 0.3], [0, 0, 0.2], [0, 0, 0]], dtype=F64))
    direction = torch.tensor([[1.0, 0.2, 0.1]], dtype=F64) * (box.verts[:, :1] > 0)

    def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        mesh = eg.Mesh(box.verts + theta * direction, box.faces, face_colors=face_colors)
        return eg.Scene([mesh], BACKGROUND), view

    fd = finite_difference(case, 0.005, 1024, 3, filter=filter)
    right_ratio(fd, gradient(case, 4, sampling=eg.Sampling(edges=50_000), filter=filter))


# -- cameras ------------------------------------------------------------------------------------------------------------


def test_defaults_show_all_around() -> None:
    view = eg.Camera.panorama(torch.eye(4), (90, 200))
    x = view.project(
        torch.tensor([[0.0, 0.0, 2.0], [3.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]])
    )
    torch.testing.assert_close(
        x, torch.tensor([[100.0, 45.0], [150.0, 45.0], [50.0, 45.0], [100.0, 67.5], [100.0, 22.5]])
    )
    assert "panorama, 90 × 200" in repr(view) and view.K.dtype == torch.float32


def test_batches_and_files(tmp_path: Path) -> None:
    scene, one = eg.Scene(balls(), BACKGROUND), camera()
    many = eg.Camera.stack([one, one.replace(world_to_camera=torch.eye(4, dtype=F64))])
    torch.testing.assert_close(eg.render(scene, many, 16, seed=0)[0], eg.render(scene, one, 16, seed=0), rtol=0, atol=0)
    eg.save_camera(tmp_path / "camera.json", one)
    back = eg.load_camera(tmp_path / "camera.json", F64)
    assert torch.equal(back.K, one.K) and back.projection == "panorama"
    assert torch.equal(eg.render(scene, back, 4, seed=0), eg.render(scene, one, 4, seed=0))


def test_plan() -> None:
    """The plan counts what is done, and samples that are asked for are shared out between the frames."""
    scene = both(PLACES["seam"])
    for mesh in scene.meshes:
        mesh.verts.requires_grad_()
    plan = eg.plan(scene, camera())
    assert plan["interior"].samples > 0 and plan["boundary"].samples > 0 and plan["silhouettes"].on
    asked = eg.plan(scene, camera(), sampling=eg.Sampling(surface=10_000, edges=5_000))
    assert asked["boundary"].samples == pytest.approx(5_000, rel=0.01)
    pinhole = camera().replace(projection="perspective")
    sizes = [
        core.image_bytes(pass_size(make_request(scene, view)), 1)["vertices in view"] for view in (camera(), pinhole)
    ]
    assert sizes[0] == 6 * sizes[1]
    assert eg.profile(scene, camera(), repeats=1).samples["edge_samples"] > 0


def test_nothing_in_view() -> None:
    one = boundary(PLACES["ahead"]).meshes[0]
    one.verts.requires_grad_()
    view = camera((96, 192)).crop(60, -20, 30, 30)
    image = eg.render(eg.Scene([one], BACKGROUND), view, 4, seed=0)
    torch.testing.assert_close(image.detach(), BACKGROUND.expand(30, 30, 3))
    image.sum().backward()
    assert one.verts.grad is not None and not one.verts.grad.any()


@pytest.mark.parametrize("crop", [(0, -400, 24, 48), (-240, 0, 24, 48), (0, 0, 24, 500)])
def test_too_many_turns(crop: tuple[int, int, int, int]) -> None:
    with pytest.raises(
        ValueError, match=r"K: expected a panorama that reaches no more than 4 turns .* got .*; K is in pixels"
    ):
        camera().crop(*crop)


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="distortion: expected None for a panorama camera"):
        camera().replace(distortion=torch.zeros(4, dtype=F64))
