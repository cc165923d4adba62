"""Gradients of everything that may require one, against exact derivatives (tests/oracles/exact.py), in every view through
every filter.

A parameter is one number θ that moves the scene or the camera; all are zero, and one backward pass gives the derivatives of
them all. The loss is the image times a fixed smooth adjoint.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from combinations import diagonal
from finite_differences import Estimate, check, estimate, rotation
from lit_scenes import vector
from oracles.exact import exact_image
from sampling_options import with_sampling
from scenes import cube, front_camera, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

SIZE = 40
AXIS = (0.48, 0.6, 0.64)


def mixed_meshes() -> dict[str, eg.Mesh]:
    """One mesh for each kind of colour; they hide one another in part."""
    f64 = torch.float64
    quad = torch.tensor([[-1.1, -0.9, -0.6], [0.9, -1.05, -0.4], [1.05, 0.8, -0.5], [-0.8, 1.0, -0.7]], dtype=f64)
    yy, xx = torch.meshgrid(torch.arange(6, dtype=f64), torch.arange(5, dtype=f64), indexing="ij")
    texture = torch.stack([0.5 + 0.4 * torch.sin(xx + k) * torch.cos(1.3 * yy + k) for k in range(3)], -1)
    tetrahedron = torch.tensor([[0.0, 0.5, 0.55], [-0.5, -0.3, 0.4], [0.45, -0.35, 0.5], [0.05, 0.0, 0.95]], dtype=f64)
    fan = torch.tensor([[0.55, 0.3, 0.3], [1.0, 0.2, 0.2], [0.95, 0.75, 0.35], [0.45, 0.85, 0.25]], dtype=f64)
    turn = rotation(AXIS, torch.tensor(0.7, dtype=f64))
    corners = smooth_colors(torch.arange(18, dtype=f64).reshape(6, 3)).reshape(2, 3, 3)
    return {
        "texture": eg.Mesh(quad, torch.tensor([[0, 1, 2], [0, 2, 3]]), texture=texture,
                           uvs=torch.tensor([[0.1, 0.05], [0.9, 0.1], [0.95, 0.9], [0.0, 0.85], [0.3, 0.3]], dtype=f64),
                           uv_faces=torch.tensor([[0, 1, 2], [4, 2, 3]])),  # a seam between the two faces
        "face_colors": eg.Mesh(tetrahedron, torch.tensor([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]),
                               face_colors=smooth_colors(3.0 * tetrahedron)),
        "corner_colors": eg.Mesh(fan, torch.tensor([[0, 1, 2], [0, 2, 3]]), corner_colors=corners),
        "colors": cube(0.22).transformed(turn, torch.tensor([-0.6, 0.55, 0.5], dtype=f64)),
    }  # fmt: skip


def background_image() -> Tensor:
    y, x = torch.meshgrid(
        torch.arange(SIZE, dtype=torch.float64), torch.arange(SIZE, dtype=torch.float64), indexing="ij"
    )
    return smooth_colors(torch.stack([x, y, x - y], -1).reshape(-1, 3) * (2.0 / SIZE)).reshape(SIZE, SIZE, 3)


def camera_of(view: str) -> eg.Camera:
    if view == "crop":
        return front_camera(2 * SIZE, "perspective").crop(top=22, left=17, height=SIZE, width=SIZE)
    return front_camera(SIZE, view)


PARAMETERS = [
    "vertex",
    "translation",
    "translation of the texture",
    "rotation",
    "scale",
    "camera translation",
    "camera rotation",
    "focal length",
    "principal point",
    "skew",
    "colors",
    "face_colors",
    "corner_colors",
    "texture",
    "texture coordinates",
    "background image",
    "background colour",
]
# Of directions for the channels: such that under this adjoint the derivatives are large.
SIGNS = {
    "colors": (1.0, 1.0, 1.0),
    "face_colors": (1.0, -0.7, 0.8),
    "corner_colors": (1.0, -0.7, -0.8),
    "texture": (1.0, 1.0, 1.0),
    "background image": (1.0, -0.7, -0.8),
    "background colour": (0.9, -0.8, -0.4),
}


def waves(like: Tensor, kind: str) -> Tensor:
    """A direction for colours (…, 3), without symmetry."""
    return (torch.cos(torch.arange(like.numel(), dtype=torch.float64)).reshape(like.shape) + 1.0) * vector(*SIGNS[kind])


def scene_and_camera(theta: dict[str, Tensor], camera: eg.Camera) -> tuple[eg.Scene, eg.Camera]:
    """Moved by all parameters."""
    meshes = mixed_meshes()
    tetrahedron, textured = meshes["face_colors"], meshes["texture"]
    move = torch.zeros_like(tetrahedron.verts)
    move[1] = vector(-0.7, -0.6, 0.4)
    meshes["face_colors"] = tetrahedron.replace(verts=tetrahedron.verts + theta["vertex"] * move)
    meshes["colors"] = meshes["colors"].transformed(t=theta["translation"] * vector(0.8, -0.5, 0.33))
    slide = vector(0.9, 0.6, 1.1, 0.8, 0.6, 1.0, 1.2, 0.5, 0.7, 0.9).reshape(5, 2)
    textured = textured.replace(uvs=textured.uvs + theta["texture coordinates"] * slide)
    meshes["texture"] = textured.transformed(t=theta["translation of the texture"] * vector(0.6, 0.7, 0.4))
    turn = rotation((0.64, -0.6, 0.48), theta["rotation"])
    for kind in list(meshes):
        mesh, value = meshes[kind], getattr(meshes[kind], kind)
        keep = {"uvs": mesh.uvs, "uv_faces": mesh.uv_faces} if kind == "texture" else {}
        mesh = mesh.replace(**{kind: value + theta[kind] * waves(value, kind)}, **keep)
        # The texture stands still, or it would show nothing new but at its sides.
        meshes[kind] = mesh if kind == "texture" else mesh.transformed(turn)
    background = background_image()
    background = background + theta["background image"] * waves(background, "background image")
    background = background + theta["background colour"] * vector(*SIGNS["background colour"])
    scene = eg.Scene(list(meshes.values()), background).transformed(scale=1 + theta["scale"])

    moved = torch.block_diag(rotation(AXIS, theta["camera rotation"]), torch.ones(1, 1, dtype=torch.float64))
    shift = theta["camera translation"] * vector(0.7, -0.5, -0.4)
    moved = moved + torch.nn.functional.pad(shift[:, None], (3, 0, 0, 1))
    K = camera.K * (1 + theta["focal length"] * vector(1, 0, 0, 0, 1, 0, 0, 0, 0).reshape(3, 3))
    K = K + theta["principal point"] * vector(0, 0, 0.8, 0, 0, -0.6, 0, 0, 0).reshape(3, 3)
    K = K + theta["skew"] * vector(0, 1, 0, 0, 0, 0, 0, 0, 0).reshape(3, 3)
    return scene, camera.replace(world_to_camera=moved @ camera.world_to_camera, K=K)


VIEWS, FILTERS = ["perspective", "orthographic", "crop"], ["box", "tent", "gaussian"]
Render = Callable[[eg.Scene, eg.Camera], Tensor]


def loss(theta: Tensor, view: str, render: Render) -> Tensor:
    image = render(*scene_and_camera(dict(zip(PARAMETERS, theta, strict=True)), camera_of(view)))
    return (image * smooth_adjoint(*image.shape)).sum()


def derivatives(view: str, render: Render) -> Tensor:
    theta = torch.zeros(len(PARAMETERS), dtype=torch.float64, requires_grad=True)
    return torch.autograd.grad(loss(theta, view, render), theta)[0]


def compared(view: str, filter: str, samples: int, seeds: int, **options: bool) -> dict[str, tuple[float, Estimate]]:
    """The exact derivative by each parameter and edgegrad's."""
    exact = derivatives(view, partial(exact_image, order=9, filter=filter))
    render = partial(eg.render, spp=64, seed=0, filter=filter, **with_sampling(options, surface=samples, edges=samples))
    runs = torch.stack([derivatives(view, partial(render, seed=seed)) for seed in range(seeds)])
    return {
        name: (truth, estimate(column.tolist()))
        for name, truth, column in zip(PARAMETERS, exact.tolist(), runs.T, strict=True)
    }


every_view_and_filter = pytest.mark.parametrize(("view", "filter"), diagonal(VIEWS, FILTERS))


@every_view_and_filter
def test_gradients_are_exact_derivatives(view: str, filter: str) -> None:
    for name, (truth, found) in compared(view, filter, samples=30_000, seeds=12).items():
        check(name, truth, found)
        for factor in (0.95, 1.05):
            with pytest.raises(AssertionError, match=f"{name}: exact"):
                check(name, truth, Estimate(factor * found.mean, factor * found.error))


@pytest.mark.slow
@every_view_and_filter
def test_gradients_are_exact_derivatives_to_a_fraction_of_a_percent(view: str, filter: str) -> None:
    for name, (truth, found) in compared(view, filter, samples=200_000, seeds=32).items():
        check(name, truth, found, slack=0.001, most=0.005)


def test_a_wrong_gradient_is_rejected() -> None:
    """Most derivatives are wrong without the boundary term. What is not known well enough is not compared."""
    for name, (truth, found) in compared("perspective", "box", 15_000, 8, visibility=False).items():
        if name in SIGNS:
            check(name, truth, found)
        elif name != "texture coordinates":
            with pytest.raises(AssertionError, match=f"{name}: exact"):
                check(name, truth, found)
    for factor in (0.0, 1.0):
        with pytest.raises(AssertionError, match="too noisy to decide"):
            check("noise", 1.0, Estimate(factor, 0.005))


# -- the exact derivatives are checked --------------------------------------------------------------------------------


@every_view_and_filter
def test_exact_image_is_what_is_rendered(view: str, filter: str) -> None:
    scene, camera = scene_and_camera(dict.fromkeys(PARAMETERS, torch.zeros(())), camera_of(view))
    exact = exact_image(scene, camera, order=9, filter=filter)
    images = torch.stack([eg.render(scene, camera, 256, seed, filter=filter) for seed in range(4)])
    # Pixels' errors hang together little: the mean of 4 images has half the error of one.
    assert 0.35 < (images.mean(0) - exact).norm() / images.std(0).norm() < 0.65


@pytest.mark.parametrize(
    ("view", "filter"),
    [
        ("crop", "gaussian"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in zip(VIEWS[:2], FILTERS[:2], strict=True)),
    ],
)
def test_exact_derivatives_are_those_of_the_exact_image(view: str, filter: str) -> None:
    """Compare all parameters at once with central differences; a step of 1e-6 leaves 1e-9 of rounding."""
    render = partial(exact_image, order=9, filter=filter)
    direction = torch.randn(len(PARAMETERS), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    high, low = (loss(step * direction, view, render).item() for step in (1e-6, -1e-6))
    along = (derivatives(view, render) * direction).sum().item()
    assert abs(along) > 100
    assert (high - low) / 2e-6 == pytest.approx(along, rel=1e-5)
