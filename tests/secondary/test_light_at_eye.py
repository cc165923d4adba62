"""Shadow boundaries that lie on the silhouette of what casts them: a light at the eye or near it, a sun along an orthographic
view, a light in one plane with the eye and upright edges.

Of a light at the eye no shadow is visible, so the derivative equals that of the scene without shadows, which has no shadow
boundaries at all. As the light leaves the eye by a small distance, the derivative changes by about as little.
"""

from __future__ import annotations

import itertools

import finite_differences
import pytest
import torch
from finite_differences import estimate, finite_difference, right_ratio
from scenes import icosphere, smooth_adjoint
from torch import Tensor

import edgegrad as eg

SIZE = 24
ASIDE = (0.6, 0.64, -0.48)  # a unit vector along no edge and no axis of the scenes
ALONG = (1.0, 0.5, 0.2)  # in which things move


def grid(dtype: torch.dtype, n: int = 2) -> eg.Mesh:
    """A square of n × n cells: its upright border is several edges on one line."""
    at = torch.linspace(-1.0, 1.0, n + 1, dtype=dtype)
    x, y = torch.meshgrid(at, at, indexing="xy")
    verts = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    first = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.stack([first, first + 1, first + n + 2, first, first + n + 2, first + n + 1], 1).reshape(-1, 3)
    return eg.Mesh(verts, faces)


def box(dtype: torch.dtype) -> eg.Mesh:
    corners = torch.tensor(list(itertools.product((-0.7, 0.7), (-0.5, 0.5), (-0.6, 0.6))), dtype=dtype)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return eg.Mesh(corners, torch.tensor([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]))


def body(name: str, dtype: torch.dtype) -> eg.Mesh:
    if name == "sphere":
        ball = icosphere(2)
        return ball.replace(verts=ball.verts.to(dtype))
    return grid(dtype) if name == "grid" else box(dtype)


class Case:
    """A body before a wall, lit from near the eye."""

    def __init__(
        self,
        shape: str = "grid",
        light: str = "point",
        offset: float = 0.0,
        dtype: torch.dtype = torch.float64,
        above: float = 0.0,
        moves: str = "body",
        projection: str = "perspective",
    ) -> None:
        self.shape, self.light, self.offset, self.dtype = shape, light, offset, dtype
        self.above, self.moves, self.projection = above, moves, projection

    def _moved(self, what: str, theta: Tensor) -> Tensor:
        return theta.to(self.dtype) * torch.tensor(ALONG, dtype=self.dtype) * (what in self.moves.split("+"))

    def __call__(self, theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        dtype = self.dtype
        mesh = body(self.shape, dtype)
        mesh = mesh.replace(verts=mesh.verts + self._moved("body", theta), material=eg.Material(0.5))
        corners = torch.tensor([[-4.0, -4, -1.5], [4, -4, -1.5], [4, 4, -1.5], [-4, 4, -1.5]], dtype=dtype)
        square = torch.tensor([[0, 1, 2], [0, 2, 3]])
        wall = eg.Mesh(corners + self._moved("wall", theta), square, material=eg.Material(0.6))
        eye = torch.tensor((1.1, 0.7, 4.0), dtype=dtype)
        shift = self._moved("camera", theta)
        still = eg.Camera.look_at(eye, torch.zeros(3, dtype=dtype), fov_y=40, size=(SIZE, SIZE))
        camera = eg.Camera.look_at(eye + shift, shift, fov_y=40, size=(SIZE, SIZE))
        if self.projection == "orthographic":
            K = torch.tensor([[6.0, 0, SIZE / 2], [0, 6, SIZE / 2], [0, 0, 1]], dtype=dtype)
            camera = camera.replace(projection="orthographic", K=K)
        elif self.projection == "fisheye":
            camera = camera.replace(projection="fisheye", distortion=torch.tensor([0.02, -0.01, 0.0, 0.0], dtype=dtype))
        away = self.offset * torch.tensor(ASIDE, dtype=dtype) + torch.tensor((0.0, self.above, 0.0), dtype=dtype)
        away = away + self._moved("light", theta)
        meshes, lights = [mesh, wall], []
        if self.light == "point":
            lights = [eg.lights.PointLight(still.eye + away, 20.0)]
        elif self.light == "spot":
            lights = [eg.lights.SpotLight(still.eye + away, -eye, 20.0, inner_angle=0.3, outer_angle=0.6)]
        elif self.light == "sun":
            lights = [eg.lights.DirectionalLight(still.world_to_camera[2, :3] + away, 3.0)]
        else:  # a light of 1e-4, a little behind the eye, so that the camera does not see it
            right, down, forward = still.world_to_camera[:3, :3]
            corners = 1e-4 * torch.stack([-right - down, right - down, down])
            emitter = still.eye + away - 1e-4 * forward + corners
            facing = torch.tensor([[0, 1, 2]])
            meshes.append(eg.Mesh(emitter, facing, material=eg.Material(0.0, emission=2e9)))
        return eg.Scene(meshes, lights=lights), camera


def gradients(case: Case, seeds: int, **options: object) -> list[float]:
    values = []
    for seed in range(seeds):
        theta = torch.zeros((), dtype=torch.float64, requires_grad=True)
        image = eg.render(*case(theta), spp=4, seed=seed, **options)  # type: ignore[arg-type]
        loss = (image.double() * smooth_adjoint(*image.shape[-3:])).sum()
        values.append(torch.autograd.grad(loss, theta)[0].item())
    return values


def check(case: Case, seeds: int = 4, samples: int = 4_000) -> None:
    """The gradient with shadows is that without, which has the same samples at silhouettes and no shadow boundaries. The slack of
    1.5 % is for offsets of 1e-4; with chance it stays below 4.5 %, so that a gradient 5 % off fails."""
    found = gradients(case, seeds, sampling=eg.Sampling(edges=samples))
    right = gradients(case, seeds, sampling=eg.Sampling(edges=samples), shadows=False)
    size = abs(estimate(right).mean)
    off = estimate([a - b for a, b in zip(found, right, strict=True)])
    assert 4 * off.error < 0.03 * size, f"too noisy to decide 5 %: {off} of {size}"
    assert abs(off.mean) < 0.015 * size + 4 * off.error, f"off by {off}, right: {size}"


LIGHTS = ("point", "spot", "sun", "area")


def lit(kind: str, **options: object) -> Case:
    return Case(light=kind, projection="orthographic" if kind == "sun" else "perspective", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "offset", "dtype"),
    [
        ("point", 0.0, torch.float32),
        ("point", 1e-7, torch.float64),
        ("spot", -1e-6, torch.float64),
        ("sun", 1e-5, torch.float32),
        ("area", 0.0, torch.float32),
    ],
)
def test_a_light_at_the_eye_adds_no_visible_shadow(kind: str, offset: float, dtype: torch.dtype) -> None:
    check(lit(kind, offset=offset, dtype=dtype))


@pytest.mark.parametrize("shape", ["box", "sphere"])
@pytest.mark.parametrize("offset", [0.0, 1e-6])
def test_a_light_at_the_eye_of_closed_bodies(shape: str, offset: float) -> None:
    check(lit("point", shape=shape, offset=offset, dtype=torch.float32))


@pytest.mark.parametrize("moves", ["camera+light", "wall", "body+wall"])
def test_a_light_at_the_eye_and_other_motions(moves: str) -> None:
    check(lit("point", offset=1e-7, moves=moves), seeds=6)


def test_a_light_at_the_eye_of_a_fisheye() -> None:
    check(Case(offset=1e-6, projection="fisheye"))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("kind", LIGHTS)
@pytest.mark.parametrize("shape", ["grid", "box", "sphere"])
def test_a_light_at_all_small_offsets_from_the_eye(shape: str, kind: str, sign: int, dtype: torch.dtype) -> None:
    for offset in (1e-12, 1e-10, 1e-8, 1e-7, 3e-7, 1e-6, 3e-6, 1e-5, 3e-5, 1e-4):
        # What a light lights is noisier, for each sample of a boundary has one of its points.
        check(lit(kind, shape=shape, offset=sign * offset, dtype=dtype), 8, 40_000 if kind == "area" else 4_000)


CLEARLY_APART = 3e-3  # world units: the derivative has changed by half a percent


@pytest.mark.parametrize(("shape", "offset"), [("grid", 0.0), ("grid", -1e-4), ("box", 1e-6)])
def test_a_light_above_the_eye_and_upright_edges(shape: str, offset: float) -> None:
    """The shadow of one edge lies on the silhouette of another one on the same line."""
    near, apart = (
        estimate(gradients(Case(shape, above=2.0, offset=away), 8, sampling=eg.Sampling(edges=8_000, surface=8_000)))
        for away in (offset, CLEARLY_APART)
    )
    finite_differences.check(shape, apart.mean, near, slack=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["grid", "box"])
@pytest.mark.parametrize("offset", [0.0, CLEARLY_APART, 0.1])
def test_a_light_above_the_eye_against_differences(shape: str, offset: float) -> None:
    """The step is short, for within 0.01 the derivative by the box changes by 2 %."""
    case = Case(shape, above=2.0, offset=offset)
    found = estimate(gradients(case, 12, sampling=eg.Sampling(edges=16_000, surface=16_000)))
    right_ratio(finite_difference(case, 0.003, 8192, 20), found)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 1e-6])
def test_with_indirect_light(offset: float) -> None:
    near, apart = (
        estimate(
            gradients(
                lit("point", shape="box", offset=away),
                32,
                sampling=eg.Sampling(edges=60_000, surface=60_000),
                bounces=2,
            )
        )
        for away in (offset, CLEARLY_APART)
    )
    finite_differences.check("bounces", apart.mean, near, slack=0.01)
