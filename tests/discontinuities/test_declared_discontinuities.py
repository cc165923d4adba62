"""Discontinuities that a shader declares: where they are found, and their gradients against exact ones."""

from __future__ import annotations

import math

import pytest
import torch
from both_modes import check_both_modes
from scenes import front_camera, icosphere, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
SIZE = 24


def ball() -> eg.Mesh:
    mesh = icosphere(2)
    return mesh.replace(verts=0.9 * mesh.verts, colors=smooth_colors(mesh.verts))


def square(turn: float = 0.0) -> eg.Mesh:
    corner = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    c, s = math.cos(turn), math.sin(turn)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=F64)
    return eg.Mesh(corner @ R.T, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def flat_camera(size: int) -> eg.Camera:
    K = torch.tensor([[0.4 * size, 0, size / 2], [0, 0.4 * size, size / 2], [0, 0, 1]], dtype=F64)
    return eg.Camera(torch.eye(4, dtype=F64), K, (size, size), "orthographic")


def test_a_straight_discontinuity_is_exact():
    """The area next to a line x = a across a square of side 2 is 2 (1 − a) scale² pixels; its derivative is −2 scale²."""
    a = torch.tensor(0.137, dtype=F64, requires_grad=True)
    image = eg.render(
        square(),
        flat_camera(32),
        shader=lambda hits: hits.where(hits.position[:, 0] - a, 3.0, 1.0),
        sampling=eg.Sampling(discontinuity_spacing=0.5),
        seed=0,
    )
    (grad,) = torch.autograd.grad(image.sum(), a)
    scale = 0.4 * 32
    # Horizontal lines cross it once each; how many there are is chance, by one.
    assert float(grad) == pytest.approx(-2 * 2 * scale**2, rel=1.01 * 0.5 / (2 * scale))


@pytest.mark.parametrize("spacing", [2.0, pytest.param(1.0, marks=pytest.mark.slow), 0.5])
def test_a_discs_area_grows_by_its_circumference(spacing: float):
    def gradient(seed: int) -> Tensor:
        r = torch.tensor(0.6, dtype=F64, requires_grad=True)
        image = eg.render(
            square(0.3),
            flat_camera(32),
            seed=seed,
            shader=lambda hits: hits.where(r - (hits.position[:, :2] - 0.05).norm(dim=1), 1.0, 0.0),
            sampling=eg.Sampling(discontinuity_spacing=spacing),
        )
        return torch.autograd.grad(image.sum(), r)[0]

    found = torch.stack([gradient(seed) for seed in range(24)])
    exact = 2 * math.pi * 0.6 * (0.4 * 32) ** 2
    error = float(found.std()) / 24**0.5
    assert error < 0.01 * exact
    assert float(found.mean()) == pytest.approx(exact, abs=4 * error + 1e-3 * exact)


def test_texels_between_neighbouring_points_all_count():
    """Stripes finer than the lines are apart: moving them changes each pixel of a coarse image, all of them together nothing;
    their duty moves the mean."""

    def gradient(seed: int) -> Tensor:
        duty = torch.tensor(0.3, dtype=F64, requires_grad=True)

        def stripes(hits: eg.points.Hits) -> Tensor:
            x = 20.3 * hits.position[:, 0]
            return (hits.floor(x) - hits.floor(x - duty))[:, None]  # 1 in the first `duty` of each stripe

        image = eg.render(square(0.2), flat_camera(24), seed=seed, shader=stripes)
        return torch.autograd.grad(image.sum(), duty)[0]

    found = torch.stack([gradient(seed) for seed in range(16)])
    exact = 4 * (0.4 * 24) ** 2
    error = float(found.std()) / 4
    assert error < 0.02 * exact
    assert float(found.mean()) == pytest.approx(exact, abs=4 * error + 5e-3 * exact)


def test_a_discontinuity_declared_twice_counts_once():
    def gradient(twice: bool) -> Tensor:
        a = torch.tensor(0.137, dtype=F64, requires_grad=True)

        def shader(hits: eg.points.Hits) -> Tensor:
            s = hits.position[:, 0] + 0.3 * hits.position[:, 1] - a
            # The product of two jumps at one place, 1 → 4, or the whole at once.
            return hits.where(s, 2.0, 1.0) * hits.where(-2 * s, 1.0, 2.0) if twice else hits.where(s, 4.0, 1.0)

        return torch.autograd.grad(eg.render(square(), flat_camera(32), shader=shader, seed=0).sum(), a)[0]

    assert torch.allclose(gradient(True), gradient(False))


def test_a_jump_of_the_function_is_not_declared():
    """Nothing is said to move where s jumps over zero, at a silhouette before another surface or by itself."""
    a = torch.tensor(0.0, dtype=F64, requires_grad=True)
    back, front = square(), square(0.4)
    scene = eg.Scene([back, front.replace(verts=0.5 * front.verts - torch.tensor([0.0, 0.0, 1.0], dtype=F64))])

    def shader(hits: eg.points.Hits) -> Tensor:
        by_mesh = torch.where(hits.mesh == 1, 1.0, -1.0)
        by_place = torch.where(hits.position[:, 1] > 0.7, 2.0, -1.0)
        return hits.where(by_mesh + a, 1.0, 0.0) + hits.where(by_place + a, 1.0, 0.0)

    (grad,) = torch.autograd.grad(eg.render(scene, flat_camera(32), shader=shader, seed=0).sum(), a)
    assert float(grad) == 0


def test_discontinuities_next_to_silhouettes_are_found():
    """A discontinuity that runs into the shadow line of another surface: the part next to it counts as well."""

    def gradient(seed: int) -> Tensor:
        a = torch.tensor(0.1, dtype=F64, requires_grad=True)
        back, front = square(), square()
        # Slats before a striped back: between two lies 1.3 px of it.
        slats = [
            front.replace(
                verts=front.verts * torch.tensor([0.05, 0.9, 1], dtype=F64) + torch.tensor([0.2 * k, 0, -1]).double()
            )
            for k in range(-3, 4)
        ]
        image = eg.render(
            eg.Scene([back, *slats]),
            flat_camera(32),
            seed=seed,
            shader=lambda hits: hits.where(hits.position[:, 1] - a, 1.0, 0.0) * (hits.mesh == 0)[:, None],
        )
        return torch.autograd.grad(image.sum(), a)[0]

    found = torch.stack([gradient(seed) for seed in range(24)])
    exact = -(2 - 7 * 0.1) * (0.4 * 32) ** 2
    error = float(found.std()) / 24**0.5
    assert error < 0.012 * abs(exact)
    assert float(found.mean()) == pytest.approx(exact, abs=4 * error + 0.005 * abs(exact))


def test_forward_mode_and_transforms():
    adjoint = smooth_adjoint(SIZE, SIZE, 3)
    mesh, camera = ball(), front_camera(SIZE)

    def image(a: Tensor, verts: Tensor) -> Tensor:
        def shader(hits: eg.points.Hits) -> Tensor:
            return hits.where(hits.position[:, 0] * (1 + a) - 0.1, 0.4 + 0.5 * hits.shading_normal, 0.2 + a)

        return eg.render(mesh.replace(verts=verts), camera, seed=3, shader=shader)

    a, verts = torch.tensor(0.2, dtype=F64), mesh.verts
    a_dot = torch.tensor(0.7, dtype=F64)
    verts_dot = 0.1 * torch.sin(3 * verts)
    bars = check_both_modes(image, [a, verts], [a_dot, verts_dot], adjoint, rel=1e-6)
    func = torch.func.grad(lambda a, v: (image(a, v) * adjoint).sum(), argnums=(0, 1))(a, verts)
    for x, y in zip(func, bars, strict=True):
        assert torch.allclose(x, y, rtol=1e-6, atol=1e-9)


def test_discontinuities_that_differ_within_a_batch_are_refused():
    def image(a: Tensor, color: Tensor) -> Tensor:
        return eg.render(
            ball(), front_camera(SIZE), shader=lambda hits: hits.where(hits.position[:, 0] - a, color, 0.0), seed=0
        )

    ones, zeros = torch.ones((2, 3), dtype=F64), torch.zeros(2, dtype=F64)
    assert torch.equal(*torch.vmap(image, (None, 0))(zeros[0], ones))
    with pytest.raises(
        RuntimeError, match=r"torch\.vmap: expected declared discontinuities that are the same for all of a batch"
    ):
        torch.vmap(image, (0, None))(zeros, ones[0])


@pytest.mark.parametrize(("wide", "least", "most"), [(30.0, 0.97, 1.02), (1.0, 0.97, 1.02), (0.5, 0.5, 0.7)])
def test_a_discontinuity_along_a_strip_of_surface(wide: float, least: float, most: float):
    """0.1 px next to the silhouette of what is wide, and along the middle of what is narrow, as the documents show."""
    turn = torch.linalg.matrix_exp(0.4 * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]], dtype=F64))
    corner = torch.tensor([[0.0, -20, 0], [wide, -20, 0], [wide, 20, 0], [0, 20, 0]], dtype=F64)
    mesh = eg.Mesh(corner @ turn.T, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    K = torch.tensor([[1.0, 0, 32], [0, 1, 32], [0, 0, 1]], dtype=F64)
    camera = eg.Camera(torch.eye(4, dtype=F64), K, (64, 64), "orthographic")
    where = 0.1 if wide > 1 else wide / 2

    def derivative(seed: int) -> Tensor:
        t = torch.zeros((), dtype=F64, requires_grad=True)
        image = eg.render(
            mesh, camera, spp=1, seed=seed,
            shader=lambda hits: hits.where((hits.position @ turn)[:, 0] - where - t, 1.0, 0.0),
        )  # fmt: skip
        return torch.autograd.grad(image.sum(), t)[0] / -40.0

    found = torch.stack([derivative(seed) for seed in range(12)])
    assert least < float(found.mean()) < most


def test_calls_that_are_not_always_made_are_refused():
    def shader(hits: eg.points.Hits) -> Tensor:
        return hits.where(hits.depth - 3, 1.0, 0.0) if len(hits) > 50 else torch.ones(len(hits), 1)

    mesh = ball()
    with pytest.raises(ValueError, match=r"shader: expected as many calls of hits\.where\(\)"):
        eg.render(
            mesh.replace(verts=mesh.verts.clone().requires_grad_()),
            front_camera(SIZE),
            shader=shader,
            sampling=eg.Sampling(edges=3),
            seed=0,
        )


def test_bad_arguments_are_refused():
    def refused(shader: object, message: str, kind: type[Exception] = ValueError) -> None:
        with pytest.raises(kind, match=message):
            eg.render(ball(), front_camera(SIZE), shader=shader, seed=0)  # type: ignore[arg-type]

    refused(lambda hits: hits.where(hits.position, 1.0, 0.0), r"s: expected shape")
    refused(lambda hits: hits.where(hits.depth, hits.position[:5], 0.0), r"a: expected rows \(N, C\)")
    refused(lambda hits: hits.where(hits.face, 1.0, 0.0), r"s: ", TypeError)
    refused(
        lambda hits: hits.where(hits.depth, torch.ones(3), torch.ones(2)), r"b: expected as many channels as a has, 3"
    )
    refused(lambda hits: hits.where(hits.depth, hits.depth, 0.0), r"a: expected rows .* a number a point is value")
    refused(lambda hits: hits.where(hits.depth / 0, 1.0, 0.0), r"s: expected finite numbers, got inf")
    refused(lambda hits: hits.sample(torch.ones(2, 2, 1), uv=hits.position[:, :2], wrap=5), r"wrap: expected")  # type: ignore[arg-type]
    refused(lambda hits: hits.select(torch.ones(3, dtype=torch.bool)).normal, r"index: expected shape")
    refused(
        lambda hits: hits.select(hits.face + len(hits)).normal, r"index: expected numbers from -\d+ to \d+, got \d+"
    )
    refused(lambda hits: hits.select(hits.depth).normal, r"index: expected integers", TypeError)
    refused(lambda hits: hits.floor(hits.face), r"t: ", TypeError)


@pytest.mark.parametrize("kind", ["where", "floor", "nearest"])
def test_discontinuities_along_edges(kind: str):
    """A border that runs exactly along edges of the mesh, of a grid of 4 × 4 squares: x = θ, with an edge at 0."""
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, 5, dtype=F64)] * 2, indexing="ij"), -1).reshape(-1, 2)
    corner = torch.tensor(
        [[5 * i + j for i, j in ((a, b), (a + 1, b), (a + 1, b + 1), (a, b + 1))] for a in range(4) for b in range(4)]
    )
    faces = torch.cat([corner[:, :3], corner[:, [0, 2, 3]]])
    mesh = eg.Mesh(torch.nn.functional.pad(grid, (0, 1)), faces)
    texture = torch.tensor([[[0.0], [1.0]]], dtype=F64)

    def gradient(seed: int) -> Tensor:
        theta = torch.zeros((), dtype=F64, requires_grad=True)

        def shader(hits: eg.points.Hits) -> Tensor:
            s = hits.position[:, 0] - theta
            if kind == "where":
                return hits.where(s, 1.0, 0.0)
            if kind == "floor":
                return 1 + hits.floor(0.5 * s)[:, None]
            return hits.sample(texture, uv=torch.stack([0.5 + s / 4, 0.5 + 0 * s], 1), filter="nearest")

        return torch.autograd.grad(eg.render(mesh, flat_camera(32), seed=seed, shader=shader).sum(), theta)[0]

    found = torch.stack([gradient(seed) for seed in range(8)]).mean()
    assert float(found) == pytest.approx(-2 * (0.4 * 32) ** 2, rel=0.03)


def test_discontinuities_of_some_points_are_those_of_all():
    """Two materials, each asked for its own points."""

    def gradient(selected: bool) -> Tensor:
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        back, front = square(), square(0.4)
        front = front.replace(verts=0.4 * front.verts - torch.tensor([0.0, 0.0, 1.0], dtype=F64))

        def of_back(hits: eg.points.Hits) -> Tensor:
            return hits.where(hits.position[:, 0] - 0.7 - theta, 1.0, 0.3)

        def of_front(hits: eg.points.Hits) -> Tensor:
            return 0.1 * hits.floor(7 * hits.position[:, 1] + theta)[:, None]

        def shader(hits: eg.points.Hits) -> Tensor:
            front = hits.mesh == 1
            if not selected:
                return torch.where(front[:, None], of_front(hits), of_back(hits))
            color = torch.zeros((len(hits), 1), dtype=F64)
            color = color.index_put(((~front).nonzero()[:, 0],), of_back(hits.select(~front)))
            return color.index_put((front.nonzero()[:, 0],), of_front(hits.select(front)))

        image = eg.render(eg.Scene([back, front]), flat_camera(32), shader=shader, seed=0)
        return torch.autograd.grad((image * smooth_adjoint(32, 32, 1)).sum(), theta)[0]

    one, all = gradient(True), gradient(False)
    assert abs(float(all)) > 1
    assert float(one) == pytest.approx(float(all), rel=1e-6)


def test_many_directions_in_one_pass():
    mesh, camera = ball(), front_camera(SIZE)

    def shader(hits: eg.points.Hits) -> Tensor:
        return hits.where(hits.position[:, 0] - 0.1, 1.0, 0.2) + hits.floor(3 * hits.position[:, 1:2])

    directions = torch.stack([0.1 * torch.sin(k * mesh.verts) for k in (1, 2, 3)])
    _, dots = eg.jvp(mesh, camera, {mesh.verts: directions}, seed=3, shader=shader)
    for direction, dot in zip(directions, dots, strict=True):
        _, one = torch.func.jvp(
            lambda v: eg.render(mesh.replace(verts=v), camera, seed=3, shader=shader), (mesh.verts,), (direction,)
        )[:2]
        assert torch.allclose(dot, one, atol=1e-9)
