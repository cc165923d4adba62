"""Fisheyes that show more than a half space: places against the formula, images against rays traced in double, areas against
outlines, gradients against finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from around import (
    BACKGROUND,
    Place,
    ball,
    both,
    boundary,
    check_area,
    check_boxes,
    check_gradient,
    moved,
    pose,
    room,
    traced,
    world,
)
from finite_differences import rotation
from kernel_parts import parts
from sampling_options import with_sampling
from scenes import smooth_adjoint
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.operators import kernel_camera, pass_size
from edgegrad.kernel.request import make_request, pack_camera
from edgegrad.library import core

F64 = torch.float64
SIZE = (40, 48)
USUAL = (0.02, -0.005, 0.0008, -0.00003)  # grows up to 180°


def camera(
    focal: float = 11.0,
    k: tuple[float, ...] = USUAL,
    skew: float = 0.0,
    size: tuple[int, int] = SIZE,
    mirror: int = 1,
) -> eg.Camera:
    H, W = size
    K = torch.tensor(
        [[focal, skew, 0.45 * W], [0.5 * skew, 1.1 * mirror * focal, 0.48 * H], [0.0, 0.0, 1.0]], dtype=F64
    )
    return eg.Camera(pose(), K, size, "fisheye", torch.tensor(k, dtype=F64))


CAMERAS = {
    "usual": camera(),
    "skewed": camera(skew=1.5),
    "mirrored": camera(mirror=-1, skew=-0.7),
    "crop": camera(22.0, size=(80, 96)).crop(-5, 40, 65, 60),  # off the axis, over the image's border
    "off the axis": camera(22.0, size=(80, 96)).crop(30, 70, 30, 36),
    "all around": camera(7.0, k=(0.0, 0.0, 0.0, 0.0)),  # the image reaches beyond 180°
    "fold": camera(k=(-0.09, 0.0, 0.0, 0.0)),  # at 110°
}
cameras = pytest.mark.parametrize(
    "view",
    [
        pytest.param(view, id=name, marks=[pytest.mark.slow] if name in ("skewed", "off the axis") else [])
        for name, view in CAMERAS.items()
    ],
)
pytestmark = [pytest.mark.watched, pytest.mark.filterwarnings("ignore:distortion")]
# Seen ahead, around 90°, and far behind that plane.
PLACES: dict[str, Place] = {"ahead": (0.9, 0.7, 2.0), "aside": (-0.8, 2.4, 0.6), "behind": (2.3, 0.4, -1.1)}


def distorted_angle(view: eg.Camera, angle: np.ndarray) -> np.ndarray:
    k = view.coefficients.tolist()
    return angle + sum(k[i] * angle ** (2 * i + 3) for i in range(4))


def end_angle(view: eg.Camera) -> float:
    """Radians, where the polynomial is greatest, or 180°."""
    angles = np.linspace(0, math.pi, 200_001)
    falls = np.diff(distorted_angle(view, angles)) <= 0
    return float(angles[np.argmax(falls)]) if falls.any() else math.pi


def position(view: eg.Camera, q: np.ndarray) -> np.ndarray:
    """Pixels (…, 2) of points (…, 3) in camera coordinates: Kannala and Brandt's formula."""
    r = np.hypot(q[..., 0], q[..., 1])
    m = (distorted_angle(view, np.arctan2(r, q[..., 2])) / r)[..., None] * q[..., :2]
    K = view.K.numpy()
    return m @ K[:2, :2].T + K[:2, 2]


def directions(view: eg.Camera, x: np.ndarray) -> np.ndarray:
    """Return the directions in the world of what is seen at pixels (N, 2), from a table of the polynomial; NaN beyond the end
    of the lens."""
    K, R = view.K.numpy(), view.world_to_camera[:3, :3].numpy()
    m = np.linalg.solve(K[:2, :2], (x - K[:2, 2])[..., None])[..., 0]
    size = np.linalg.norm(m, axis=-1)
    angles = np.linspace(0, end_angle(view), 200_001)
    angle = np.interp(size, distorted_angle(view, angles), angles, right=math.nan)
    return np.concatenate([np.sin(angle)[:, None] * m / size[:, None], np.cos(angle)[:, None]], 1) @ R


def sub_cameras(view: eg.Camera, reach: float = 0.0) -> list:
    return parts.sub_cameras(kernel_camera(pack_camera(view)), reach)


# -- positions ----------------------------------------------------------------------------------------------------------


@pytest.mark.unwatched
@cameras
def test_points_agree_with_the_formula(view: eg.Camera) -> None:
    """One sub-camera shows each point up to 110° and beyond, at the position that Camera.project says."""
    (H, W), end, count = view.size, end_angle(view), 0
    through = sub_cameras(view)
    for q in np.random.default_rng(0).normal(size=(200, 3)):
        expected = position(view, q)
        np.testing.assert_allclose(view.project(world(torch.from_numpy(q))).numpy(), expected, atol=1e-9)
        found = []
        for sub_camera, turn in through:
            x, y, z = np.array(turn) @ q
            if z > 0 and max(abs(x), abs(y)) <= z:
                found.append(parts.project(sub_camera, [x, y, z]))
                seen = parts.distort(sub_camera, parts.project_straight(sub_camera, [x, y, z]), [0.0, 0.0])[1]
                assert (seen > 0) == (math.atan2(math.hypot(q[0], q[1]), q[2]) < end)
        inside = 0 < expected[0] < W and 0 < expected[1] < H and math.atan2(math.hypot(q[0], q[1]), q[2]) < end
        assert len(found) == 1 or not inside
        for x in found:
            np.testing.assert_allclose(x, expected, atol=1e-9)
        count += inside
    assert count > 10


def test_points_agree_with_opencv() -> None:
    """OpenCV has points before the camera; compare up to 89.9°."""
    view = camera()
    K = view.K.numpy() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rng = np.random.default_rng(0)
    angle, around = rng.uniform(0.1, math.radians(89.9), 200), rng.uniform(0, math.tau, 200)
    q = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    expected, _ = cv2.fisheye.projectPoints(q[:, None], np.zeros(3), np.zeros(3), K, view.coefficients.numpy())
    np.testing.assert_allclose(view.project(world(torch.from_numpy(q))).numpy(), expected[:, 0] + 0.5, atol=1e-9)


@cameras
def test_every_pixel_position_belongs_to_one_sub_camera(view: eg.Camera) -> None:
    """This holds on the borders between them, too; positions beyond the end of the lens belong to none. The direction there is
    seen at that position."""
    H, W = view.size
    x = [
        *np.random.default_rng(0).uniform((0, 0), (W, H), (300, 2)),
        *np.mgrid[0 : W + 1 : 3, 0 : H + 1 : 3].reshape(2, -1).T,
    ]
    through, K = sub_cameras(view), view.K.numpy()
    reach = distorted_angle(view, np.array(end_angle(view)))
    for place in x:
        found = [np.array(parts.normalised(sub_camera, place)) for sub_camera, _ in through]
        seen = [i for i, n in enumerate(found) if np.isfinite(n).all()]
        size = np.linalg.norm(np.linalg.solve(K[:2, :2], place - K[:2, 2]))
        assert len(seen) == (size < reach)
        for i in seen:
            q = np.array(through[i][1]).T @ [*found[i], 1.0]
            if np.hypot(q[0], q[1]) > 0:
                np.testing.assert_allclose(position(view, q), place, atol=1e-9)


@cameras
def test_boxes_hold_what_they_say(view: eg.Camera) -> None:
    for sub_camera, _ in sub_cameras(view):
        check_boxes(sub_camera, shown_whole=False)


@cameras
def test_distortion_derivatives(view: eg.Camera) -> None:
    """The kernel's derivatives of a position by the point, K and the coefficients: against autograd, in both modes."""
    rng = np.random.default_rng(2)
    M, bar, k_dot, end = view.world_to_camera, rng.normal(size=2), rng.normal(size=14), end_angle(view)
    for sub_camera, turn in sub_cameras(view):
        for n in rng.uniform(-0.95, 0.95, (5, 2)):
            q = torch.from_numpy(np.array(turn).T @ [*n, 1.0]).requires_grad_()
            leaves = [q, view.K.clone().requires_grad_(), view.coefficients.clone().requires_grad_()]
            x, y, z = q.tolist()
            if math.atan2(math.hypot(x, y), z) > end:
                continue
            p = (leaves[0] - M[:3, 3]) @ M[:3, :3]
            x = view.replace(K=torch.cat([leaves[1][:2], view.K[2:]]), distortion=leaves[2]).project(p)
            truth = [g.numpy() for g in torch.autograd.grad((x * torch.from_numpy(bar)).sum(), leaves)]
            found = parts.project_vjp(sub_camera, [*n, 1.0], bar)
            np.testing.assert_allclose(np.array(turn).T @ found[0], truth[0], atol=1e-8)
            np.testing.assert_allclose(found[1], truth[1][:2].reshape(-1), atol=1e-9)
            np.testing.assert_allclose(found[2][:4], truth[2], atol=1e-9)
            assert not any(found[2][4:])
            moved_x = parts.project_jvp(sub_camera, [*n, 1.0], np.zeros(3), k_dot)
            expected = np.dot(k_dot[:6], found[1]) + np.dot(k_dot[6:10], truth[2])
            np.testing.assert_allclose(np.dot(bar, moved_x), expected, atol=1e-9)


# -- images -------------------------------------------------------------------------------------------------------------


@cameras
def test_image_against_traced_rays(view: eg.Camera) -> None:
    scene = eg.Scene([*(ball(place) for place in PLACES.values()), room()], BACKGROUND)
    expected, image = traced(scene, view, 3, lambda x: directions(view, x)), eg.render(scene, view, 256, seed=0)
    # The border of a face may pass anywhere between the rays of the grid.
    assert float((image - expected).abs().mean()) < 0.01
    assert float((image - expected).abs().max()) < 0.3


def test_a_narrow_crop_is_what_the_wide_image_shows_there() -> None:
    """One pinhole does for it, with another tracing of the same rays."""
    wide, scene = camera(22.0, size=(80, 96)), eg.Scene([ball(PLACES["ahead"]), room()], BACKGROUND)
    narrow = wide.crop(30, 40, 16, 20)
    assert (kernel_camera(pack_camera(wide)).sides, kernel_camera(pack_camera(narrow)).sides) == (6, 1)
    part = eg.render(scene, wide, 256, seed=0)[30:46, 40:60]
    assert float((eg.render(scene, narrow, 256, seed=0) - part).abs().max()) < 0.05


def test_what_lies_beyond_the_end_of_the_lens() -> None:
    """It is background, and the warning says where; a crop that shows nothing else is background too."""
    white = room().replace(colors=torch.ones((8, 3), dtype=F64))
    scene, view = eg.Scene([white], torch.zeros(3, dtype=F64)), CAMERAS["fold"]
    angle = 1 / math.sqrt(0.27)
    with pytest.warns(UserWarning, match=rf"nothing beyond {math.degrees(angle):.4g}° from its axis"):
        image = eg.render(scene, view, 256, seed=0)
    expected = math.pi * (2 / 3 * angle) ** 2 * float(torch.linalg.det(view.K))
    assert float(image[..., 0].sum()) == pytest.approx(expected, rel=2e-3)
    corner = view.crop(0, 0, 3, 3)
    verts = white.verts.clone().requires_grad_()
    image = eg.render(scene.replace(meshes=[white.replace(verts=verts)]), corner, 4, seed=0)
    image.sum().backward()
    assert not image.any() and verts.grad is not None and not verts.grad.any()


def test_no_warning_where_the_lens_ends_outside() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("edgegrad.kernel.operators.warn", lambda *_: pytest.fail("warned"))
        eg.render(ball(PLACES["ahead"]), CAMERAS["usual"], 1, seed=0)


# -- areas --------------------------------------------------------------------------------------------------------------

AHEAD = torch.tensor([[-0.7, -0.6, 1.3], [0.9, -0.3, 1.6], [-0.2, 0.8, 1.2]], dtype=F64)


@pytest.mark.parametrize(
    ("degrees", "skew"),
    [
        (0, 0.0),
        (85, 1.5),
        (130, 0.0),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((95, 0.0), (110, 1.5))),
    ],
)
def test_area_of_a_triangle(degrees: int, skew: float) -> None:
    """Its sum in the image, and the derivative in everything that moves it: of its outline, chord by chord."""
    turn = rotation((0.3, 0.9, 0.316), torch.tensor(math.radians(degrees), dtype=F64))
    check_area(camera(8.0, skew=skew), world(AHEAD @ turn.mT))


def test_area_of_a_triangle_that_reaches_around() -> None:
    """The triangle reaches from ahead to behind, through several sub-cameras, and past the eye."""
    check_area(camera(8.0), world(torch.tensor([[0.3, -2.0, 1.5], [2.5, 0.4, -1.2], [0.2, 1.6, 0.5]], dtype=F64)))


# -- gradients ----------------------------------------------------------------------------------------------------------


@pytest.mark.unwatched
@pytest.mark.parametrize(
    ("place", "what"),
    [
        ("behind", "d1"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("aside", "vertices"), ("behind", "K11"))),
    ],
)
def test_gradient(place: str, what: str) -> None:
    case = moved(lambda dx=0.0: both(PLACES[place], dx), camera(), what)
    check_gradient(case, spp=512, seeds=3, step=0.01 if what[0] == "d" else 0.005)


WHAT = ["vertices", "turn", "shift", "K00", "K01", "K02", "K11", "K12", "d0", "d1", "d2", "d3"]
# Half of all, in views where the lens ends outside.
VIEWS = ["usual", "skewed", "crop"]
SOME = [
    (place, kind, view, what)
    for i, place in enumerate(PLACES)
    for j, kind in enumerate((boundary, both))
    for k, what in enumerate(WHAT)
    if (i + j + k) % 2
    and (place, view := VIEWS[(i + j + k) // 2 % 3]) != ("aside", "crop")  # not in view
    # High powers of the angle move what is far from the axis alone.
    and (place == "behind" or what not in ("d2", "d3"))
    and (place, what) != ("ahead", "d1")
]


@pytest.mark.slow
@pytest.mark.parametrize(("place", "kind", "view", "what"), SOME)
def test_gradients(place: str, kind: Callable[..., eg.Scene], view: str, what: str) -> None:
    """The filter makes the loss smooth."""
    case = moved(lambda dx=0.0: kind(PLACES[place], dx), CAMERAS[view], what)
    check_gradient(case, spp=4096, seeds=6, step=0.01 if what[0] == "d" else 0.02, filter="tent")


@pytest.mark.slow
def test_gradient_around_the_antipode() -> None:
    """A ball right behind, which a lens that shows all around draws as a ring: areas grow without bound there."""
    case = moved(lambda dx=0.0: both((0.2, 0.1, -2.5), dx), CAMERAS["all around"], "vertices")
    check_gradient(case, filter="tent", step=0.01)


def test_channels() -> None:
    """Alpha is the image of a white mesh, depth and position are those of the points that traced rays meet."""
    scene, view = eg.Scene([ball(PLACES["behind"]), room()], BACKGROUND), camera()
    layers = eg.render_aovs(scene, view, ["image", "alpha", "position"], spp=256, seed=0)
    assert float((1 - layers["alpha"]).sum()) < 4 / 256  # floats let a ray in a million pass between two faces
    torch.testing.assert_close(layers["image"], eg.render(scene, view, 256, seed=0), rtol=0, atol=0)
    places = [m.replace(colors=m.verts) for m in scene.meshes]
    expected = traced(scene.replace(meshes=places), view, 3, lambda x: directions(view, x))
    assert float((layers["position"] - expected).abs().mean()) < 0.05


def test_shader() -> None:
    """A shader gives the image, and the gradient by everything that moves it, that the kernel gives without one."""
    scene, view, adjoint = both(PLACES["behind"]), camera(), smooth_adjoint(*SIZE, 3)
    colors = torch.cat([m.colors for m in scene.meshes if m.colors is not None])

    def shader(hits: eg.points.Hits) -> Tensor:
        return hits.interpolate(colors, "vertex")

    found = []
    options: dict[str, Any]
    for options in ({}, {"shader": shader}):
        leaves = [view.world_to_camera, view.K, view.coefficients, *(m.verts for m in scene.meshes)]
        M, K, d, *verts = leaves = [t.clone().requires_grad_() for t in leaves]
        meshes = [m.replace(verts=v) for m, v in zip(scene.meshes, verts, strict=True)]
        distorted = view.replace(world_to_camera=M, K=K, distortion=d)
        image = eg.render(
            scene.replace(meshes=meshes),
            distorted,
            64,
            **{"seed": 0, **with_sampling(options, surface=100_000, edges=50_000)},
        )
        found.append((image.detach(), *torch.autograd.grad((image * adjoint).sum(), leaves)))
    assert float((found[0][0] - found[1][0]).abs().mean()) < 0.01  # it is asked at one point of a face in a pixel
    for a, b in zip(*(f[1:] for f in found), strict=True):
        torch.testing.assert_close(b, a, rtol=0.05, atol=0.03 * float(a.abs().max()))


def test_batches_and_memory() -> None:
    """Cameras with one plane and with several go together; memory is counted for the widest."""
    scene = eg.Scene([ball(PLACES["ahead"]), room()], BACKGROUND)
    wide = camera()
    narrow = wide.replace(K=wide.K * torch.tensor([[3.0, 1, 1], [1, 3.0, 1], [1, 1, 1]], dtype=F64))
    both_of_them = eg.Camera.stack([narrow, wide])
    images = eg.render(scene, both_of_them, 16, seed=0)
    torch.testing.assert_close(images[0], eg.render(scene, narrow, 16, seed=0), rtol=0, atol=0)
    sizes = [core.image_bytes(pass_size(make_request(scene, v)), 1)["vertices in view"] for v in (narrow, both_of_them)]
    assert sizes[1] == 6 * sizes[0]
