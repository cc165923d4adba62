"""Lenses that distort: positions against OpenCV, gradients against finite differences of the image."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from around import area, check_area
from finite_differences import loss, rotation
from kernel_parts import parts
from lens_cases import DISTORTION, F64, SIZE, camera, check_gradient, colored_sphere, scene
from scenes import smooth_adjoint
from torch import Tensor

import edgegrad as eg
from edgegrad.camera.lens import distort
from edgegrad.kernel.operators import kernel_camera
from edgegrad.kernel.request import pack_camera

lenses = pytest.mark.parametrize("lens", DISTORTION)


# -- positions ----------------------------------------------------------------------------------------------------------


@lenses
def test_points_agree_with_opencv(lens: str) -> None:
    # projectPoints reads no skew; fisheye's takes it as a share of the focal length.
    view = camera(lens, skew=1.5 if lens == "fisheye" else 0.0)
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (200, 1, 3))
    M, K, d = (t.numpy() for t in (view.world_to_camera, view.K, view.coefficients))
    K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # its first pixel's centre is at 0
    turn = cv2.Rodrigues(M[:3, :3])[0]
    if lens == "fisheye":
        expected, _ = cv2.fisheye.projectPoints(points, turn, M[:3, 3], K, d, alpha=K[0, 1] / K[0, 0])
    else:
        expected, _ = cv2.projectPoints(points, turn, M[:3, 3], K, d)
    expected = expected[:, 0] + 0.5
    np.testing.assert_allclose(view.project(torch.from_numpy(points[:, 0])).numpy(), expected, atol=1e-9)
    kernel = kernel_camera(pack_camera(view))
    q = points[:, 0] @ M[:3, :3].T + M[:3, 3]
    np.testing.assert_allclose([parts.project(kernel, p) for p in q], expected, atol=1e-9)


@lenses
def test_position_gradient(lens: str) -> None:
    view = camera(lens)
    inputs = [t.clone().requires_grad_() for t in (view.world_to_camera, view.K, view.coefficients)]
    points = torch.tensor([[0.3, 0.2, 0.1], [-0.8, 0.9, 0.5]], dtype=F64)

    def positions(M: Tensor, K: Tensor, d: Tensor) -> Tensor:
        M = torch.cat([M[:3], view.world_to_camera[3:]])
        K = torch.cat([K[:2], view.K[2:]])
        return view.replace(world_to_camera=M.detach() + (M - M.detach()), K=K, distortion=d).project(points)

    assert torch.autograd.gradcheck(lambda K, d: positions(inputs[0].detach(), K, d), inputs[1:])


@lenses
def test_boxes_hold_what_they_say(lens: str) -> None:
    """All of a box of the undistorted image is seen in the box that the kernel names, also where that reaches far outside."""
    kernel = kernel_camera(pack_camera(camera(lens)))
    rng = np.random.default_rng(1)
    for _ in range(200):
        middle, half = rng.uniform(-30, 80, 2), rng.uniform(0, 20, 2) ** 2 / 10
        low, high = parts.image_box(kernel, middle - half, middle + half)
        for u in rng.uniform(middle - half, middle + half, (30, 2)):
            x, area_scale, _ = parts.distort(kernel, u, [0.0, 0.0])
            if area_scale > 0 and (np.array(x) > -1).all() and x[0] < SIZE[1] + 1 and x[1] < SIZE[0] + 1:
                assert (np.array(x) >= np.array(low) - 1e-9).all() and (np.array(x) <= np.array(high) + 1e-9).all()


# -- images -------------------------------------------------------------------------------------------------------------


TRIANGLE = torch.tensor([[-0.6, -0.5, 0.3], [0.8, -0.2, -0.6], [-0.1, 0.7, 0.2]], dtype=F64)


@lenses
def test_area_of_a_triangle(lens: str) -> None:
    view = camera(lens)
    check_area(view, TRIANGLE)
    undistorted_area = area(view.replace(distortion=None, projection="perspective"), TRIANGLE)
    assert abs(float(undistorted_area / area(view, TRIANGLE)) - 1) > 0.01, "a pinhole would pass as well"


@pytest.mark.filterwarnings("ignore:distortion")
@pytest.mark.parametrize("degrees", [*(pytest.param(d, marks=pytest.mark.slow) for d in (0, 40)), 70, 80])
def test_area_in_a_wide_fisheye(degrees: int) -> None:
    """The image reaches beyond 88°, where a fisheye ends."""
    K = torch.tensor([[14.0, 0.0, 23.5], [0.0, 14.0, 19.5], [0.0, 0.0, 1.0]], dtype=F64)
    view = eg.Camera.fisheye(torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), K, SIZE, torch.zeros(4, dtype=F64))
    ahead = torch.tensor([[-0.2, -0.2, 1.0], [0.1, -0.1, 1.0], [0.0, 0.2, 1.0]], dtype=F64)
    turn = rotation((0.0, 1.0, 0.0), torch.tensor(math.radians(degrees), dtype=F64))
    check_area(view, ahead @ turn.mT)


@lenses
def test_interior_derivatives_of_a_wall(lens: str) -> None:
    """A triangle that fills the view has an interior term alone: against quadrature in double, differentiated by autograd."""
    view = camera(lens)
    wall = scene("interior").meshes[0]
    assert wall.colors is not None
    leaves = [t.clone().requires_grad_() for t in (wall.verts, view.world_to_camera, view.K, view.coefficients)]
    verts, M, K, d = leaves
    view = view.replace(world_to_camera=M, K=K, distortion=d)
    H, W = SIZE
    grid = 6
    x, y = ((torch.arange(n * grid, dtype=F64) + 0.5) / grid for n in (W, H))
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    n = undistorted(view, points)
    q = verts @ M[:3, :3].mT + M[:3, 3]
    b = torch.linalg.solve(q.mT, torch.cat([n, torch.ones_like(n[:, :1])], 1).mT).mT
    assert bool((b > 0).all()), "it must fill the view"
    radiance = (b / b.sum(1, keepdim=True)) @ wall.colors
    expected = radiance.reshape(H, grid, W, grid, 3).mean((1, 3))
    image = eg.render(wall.replace(verts=verts), view, 64, sampling=eg.Sampling(surface=100_000), seed=0)
    torch.testing.assert_close(image, expected, rtol=0, atol=5e-3)
    adjoint = smooth_adjoint(H, W, 3)
    truth, found = (torch.autograd.grad((value * adjoint).sum(), leaves) for value in (expected, image))
    for name, a, b in zip(("verts", "world_to_camera", "K", "distortion"), truth, found, strict=True):
        torch.testing.assert_close(b, a, rtol=5e-3, atol=5e-3 * float(a.abs().max()), msg=lambda m, n=name: f"{n}: {m}")


def undistorted(view: eg.Camera, x: Tensor) -> Tensor:
    """n (N, 2) of what is seen at the pixels x (N, 2): Newton's method, its last step differentiable."""
    m = torch.linalg.solve(view.K[:2, :2], (x - view.K[:2, 2])[..., None])[..., 0]
    n = m.detach()
    for _ in range(30):
        n = n.detach().requires_grad_()
        distorted = distort(view.projection, torch.cat([n, torch.ones_like(n[:, :1])], 1), view.coefficients)
        rows = [torch.autograd.grad(distorted[:, i].sum(), n, retain_graph=True)[0] for i in (0, 1)]
        n = n.detach() + torch.linalg.solve(torch.stack(rows, 1), (m - distorted)[..., None])[..., 0]
    return n


WHAT = ["vertices", "pose", "K00", "K11", "K01", "K02", "K12"]


@pytest.mark.slow
@pytest.mark.parametrize("crop", [False, True], ids=["whole", "crop"])
@lenses
@pytest.mark.parametrize("kind", ["boundary", "interior", "both"])
def test_every_gradient(lens: str, kind: str, crop: bool) -> None:
    view = camera(lens, size=(80, 96))
    if crop:
        view = view.crop(-10, 30, 50, 60)  # reaches beyond the image, where the lens distorts most
    for what in [*WHAT, *(f"d{i}" for i in range(len(DISTORTION[lens])))]:
        # Coefficients of high powers move little, so differences say less of them; test_area_of_a_triangle is exact.
        check_gradient(kind, view, what, spp=4096, seeds=8, most_noise=0.05)


# -- cameras ------------------------------------------------------------------------------------------------------------


@lenses
def test_batches_and_files(lens: str, tmp_path: Path) -> None:
    one = camera(lens)
    other = one.replace(distortion=0.5 * one.coefficients)
    many = eg.Camera.stack([one, other])
    images = eg.render(colored_sphere(), many, 16, seed=0)
    torch.testing.assert_close(images[0], eg.render(colored_sphere(), one, 16, seed=0), rtol=0, atol=0)
    shared = one.replace(distortion=many.distortion)
    assert shared.batch == 2 and torch.equal(eg.render(colored_sphere(), shared, 16, seed=0), images)
    d = many.coefficients.clone().requires_grad_()
    loss(eg.Scene([colored_sphere()]), one.replace(distortion=d[1]), spp=16).backward()
    assert d.grad is not None and (d.grad[1] != 0).all() and (d.grad[0] == 0).all()
    eg.save_camera(tmp_path / "camera.json", one)
    back = eg.load_camera(tmp_path / "camera.json", F64)
    assert torch.equal(back.coefficients, one.coefficients) and back.projection == one.projection
    assert one.detach().to(torch.float32).coefficients.dtype == torch.float32


@pytest.mark.parametrize("count", [12, 14])
def test_longer_lists_of_opencv(count: int) -> None:
    """Coefficients of models that edgegrad does not have must be zero."""
    view = camera("eight")
    longer = torch.nn.functional.pad(view.coefficients, (0, count - 8))
    assert torch.equal(view.replace(distortion=longer).coefficients, view.coefficients)
    longer[-1] = 0.01
    what = "thin prism" if count == 12 else "tilt"
    with pytest.raises(ValueError, match=rf"distortion: expected .*4, 5 or 8.* got {count}.*{what}.*cv2.undistort"):
        view.replace(distortion=longer)
    with pytest.raises(ValueError, match=rf"distortion: expected 4, 5 or 8 .* got {count}; leave out the zeros"):
        torch.func.vmap(lambda d: view.replace(distortion=d).K)(longer[None])


def test_what_is_refused() -> None:
    view = camera("four")
    with pytest.raises(ValueError, match=r"distortion: expected shape .*4.*5.*8.*got \(6,\)"):
        view.replace(distortion=torch.zeros(6, dtype=F64))
    with pytest.raises(ValueError, match=r"distortion: .*finite"):
        view.replace(distortion=torch.full((4,), math.nan, dtype=F64))
    with pytest.raises(ValueError, match="distortion: expected None for an orthographic camera"):
        view.replace(projection="orthographic")
    with pytest.raises(ValueError, match="distortion: expected a batch of 2 like K, got 3"):
        view.replace(K=view.K.repeat(2, 1, 1), distortion=torch.zeros((3, 4), dtype=F64))


# -- tables ---------------------------------------------------------------------------------------------------------------


def normalised_places(view: eg.Camera, pixels: list[tuple[int, int]], places: np.ndarray) -> np.ndarray:
    """n (P, N, 2) of the rays through places (N, 2) of the unit square of each pixel, as images have them."""
    kernel = kernel_camera(pack_camera(view))
    return np.array([parts.place_in_pixel(kernel, x, y, places.tolist()) for x, y in pixels])


RADIAL = {
    "k1": ("perspective", [-0.1, 0.0, 0.0, 0.0]),
    "stronger": ("perspective", [-0.25, 0.08, 0.0, 0.0, 0.03]),
    "rational": ("perspective", [0.3, 0.05, 0.0, 0.0, 0.02, 0.4, 0.1, 0.03]),
    "pincushion": ("perspective", [0.4, 0.1, 0.0, 0.0]),
    "decentred": ("perspective", DISTORTION["four"]),
    "fisheye": ("fisheye", DISTORTION["fisheye"]),
    "equidistant": ("fisheye", [0.0, 0.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("focal", [2000.0, 60.0, 25.0])
@pytest.mark.parametrize("lens", RADIAL)
def test_rays_of_pixels_come_back_to_where_they_were_drawn(lens: str, focal: float) -> None:
    """The inverse, by tables or by steps, within a few spacings of doubles; also near the fold, where tables end."""
    projection, values = RADIAL[lens]
    K = torch.tensor([[focal, 0.3, 23.0], [0.0, 1.1 * focal, 19.0], [0.0, 0.0, 1.0]], dtype=F64)
    distortion = torch.tensor(values, dtype=F64)
    view = eg.Camera(torch.eye(4, dtype=F64), K, SIZE, projection, distortion)
    pixels = [(x, y) for x in range(0, SIZE[1], 3) for y in range(0, SIZE[0], 3)]
    places = np.random.default_rng(3).uniform(0, 1, (16, 2))
    n = torch.from_numpy(normalised_places(view, pixels, places))
    seen = n.isfinite().all(-1)
    assert bool(seen[len(seen) // 2].all())
    m = distort(projection, torch.cat([n, torch.ones_like(n[..., :1])], -1), distortion)
    x = m @ K[:2, :2].T + K[:2, 2]
    expected = torch.tensor(pixels, dtype=F64)[:, None] + torch.from_numpy(places)
    torch.testing.assert_close(x[seen], expected[seen], rtol=0, atol=1e-11 * max(focal, 100.0))


def test_each_camera_has_a_table_of_its_own() -> None:
    """Cameras in turns, which differ in their coefficients, K or size alone, show what they show when they come first."""
    first = camera("fisheye")
    others = [
        first.replace(distortion=first.coefficients * 1.05),
        first.replace(K=first.K * torch.tensor([[1.05, 1, 1], [1, 1, 1], [1, 1, 1]], dtype=F64)),
        first.replace(size=(SIZE[0], SIZE[1] + 2)),
        first.replace(projection="perspective"),
        first,
    ]
    places = np.array([[0.25, 0.75], [0.5, 0.5]])
    pixels = [(2, 3), (40, 30)]
    found = [normalised_places(view, pixels, places) for view in others]
    for view, n in zip(others, found, strict=True):
        q = torch.from_numpy(np.concatenate([n, np.ones_like(n[..., :1])], -1))
        x = distort(view.projection, q, view.coefficients) @ view.K[:2, :2].T + view.K[:2, 2]
        np.testing.assert_allclose(x.numpy(), np.array(pixels)[:, None] + places, rtol=0, atol=1e-8)
    # Many more than are remembered.
    for step in range(100):
        normalised_places(
            first.replace(
                K=first.K + torch.tensor(1e-3 * step, dtype=F64) * torch.tensor([[1.0, 0, 0], [0, 0, 0], [0, 0, 0]])
            ),
            pixels[:1],
            places,
        )
    np.testing.assert_array_equal(normalised_places(first, pixels, places), found[-1])


def test_threads_that_change_lenses_find_their_own() -> None:
    views = [
        camera("fisheye").replace(K=camera("fisheye").K * torch.tensor([[s, s, 1], [s, s, 1], [1, 1, 1]]))
        for s in (1.0, 1.1)
    ]
    mesh = colored_sphere()
    right = [eg.render(mesh, view, 4, seed=0) for view in views]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda i: eg.render(mesh, views[i % 2], 4, seed=0), range(12)))
    for i, image in enumerate(found):
        assert torch.equal(image, right[i % 2])


@pytest.mark.parametrize("spp", [1, 16])
def test_a_lens_of_zeros_renders_as_its_pinhole(spp: int) -> None:
    """Images have the same bits, and so have gradients that leave the coefficients alone."""
    mesh, view = colored_sphere(), camera("four").replace(distortion=None)
    zero = view.replace(distortion=torch.zeros(5, dtype=F64))
    adjoint = smooth_adjoint(*SIZE, 3)

    def image_and_gradient(view: eg.Camera) -> tuple[Tensor, Tensor]:
        verts = mesh.verts.clone().requires_grad_()
        image = eg.render(mesh.replace(verts=verts), view, spp, seed=0)
        return image.detach(), torch.autograd.grad((image * adjoint).sum(), verts)[0]

    for found, right in zip(image_and_gradient(zero), image_and_gradient(view), strict=True):
        assert torch.equal(found, right)


@pytest.mark.parametrize("index", [0, 2])
def test_gradient_by_coefficients_of_zero(index: int) -> None:
    """It is that of coefficients next to zero, through which no image is taken for a pinhole's; in forward mode, too."""
    mesh, view = colored_sphere(0.3), camera("four").replace(distortion=None)
    adjoint = smooth_adjoint(*SIZE, 3)
    direction = torch.eye(4, dtype=F64)[index]

    def loss_at(t: Tensor) -> Tensor:
        image = eg.render(
            mesh, view.replace(distortion=t * direction), sampling=eg.Sampling(surface=100_000, edges=40_000), seed=0
        )
        return (image * adjoint).sum()

    def gradient_at(value: float) -> float:
        t = torch.tensor(value, dtype=F64, requires_grad=True)
        return float(torch.autograd.grad(loss_at(t), t)[0])

    one = torch.ones((), dtype=F64)
    near_zero = gradient_at(1e-9)
    assert gradient_at(0.0) == pytest.approx(near_zero, rel=0.01)
    assert float(torch.func.jvp(loss_at, (0 * one,), (one,))[1]) == pytest.approx(near_zero, rel=0.01)


@lenses
def test_pixels_without_rays_show_nothing(lens: str) -> None:
    """Only pixels near the mesh get rays; a far wall behind it makes that all pixels, and hides nothing of the mesh."""
    view = camera(lens)
    mesh = colored_sphere(0.4)
    wall = eg.Mesh(
        torch.tensor([[-90.0, -90, 9], [90, -90, 9], [0, 90, 9]], dtype=F64) @ view.world_to_camera[:3, :3]
        - view.world_to_camera[:3, 3] @ view.world_to_camera[:3, :3],
        torch.tensor([[0, 1, 2]]),
        colors=torch.zeros((3, 3), dtype=F64),
    )
    alone = eg.render(mesh, view, 16, seed=0)
    before = eg.render(eg.Scene([mesh, wall]), view, 16, seed=0)
    assert float(alone.amax()) > 0.5
    torch.testing.assert_close(alone, before, rtol=0, atol=1e-12)
