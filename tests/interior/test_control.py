"""The controls of faces and creases: they must not change what is estimated, however wrong it is, and need few samples where they
are right."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from combinations import diagonal
from oracles.exact import exact_image
from scenes import front_camera, icosphere, smooth_adjoint
from torch import Tensor

import edgegrad as eg
from benchmarks.error_time.methods import default_samples, differentiate
from benchmarks.scenes import build, unproject

F64 = torch.float64
CAMERA = front_camera(48)


def bars(n: int = 40) -> eg.Mesh:
    """Triangles a fraction of a pixel wide right across the picture, one behind another, before everything else."""
    random = torch.Generator().manual_seed(0)
    begin, end = (48 * torch.rand(2, n, 2, generator=random, dtype=F64)).unbind(0)
    corners = torch.stack([begin, end, end + torch.tensor([0.3, 0.2], dtype=F64)], 1).reshape(-1, 2)
    verts = unproject(CAMERA, corners, 2.5 + 0.001 * torch.arange(3 * n, dtype=F64).div(3, rounding_mode="floor"))
    colors = torch.rand(3 * n, 3, generator=random, dtype=F64)
    return eg.Mesh(verts, torch.arange(3 * n).reshape(-1, 3), colors=colors)


def turned_away() -> eg.Mesh:
    """Small triangles before everything else, seen from the side from which no other face is: chance tells which the image
    hits, and what it misses gets few samples."""
    random = torch.Generator().manual_seed(2)
    centre = 8 + 32 * torch.rand(60, 1, 2, generator=random, dtype=F64)
    corners = (centre + torch.tensor([[0.0, 0.0], [0.5, 0.1], [0.2, 0.4]], dtype=F64)).reshape(-1, 2)
    verts = unproject(CAMERA, corners, 2.5 + 0.001 * torch.arange(180, dtype=F64).div(3, rounding_mode="floor"))
    return eg.Mesh(verts, torch.arange(180).reshape(-1, 3), colors=random_colors(180))


def random_colors(n: int) -> Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(1), dtype=F64)


def apart(mesh: eg.Mesh) -> eg.Mesh:
    """Each face with vertices of its own: none has neighbours that show whether it was seen."""
    assert mesh.colors is not None
    corners = mesh.faces.reshape(-1)
    return mesh.replace(
        verts=mesh.verts[corners], colors=mesh.colors[corners], faces=torch.arange(len(corners)).reshape(-1, 3)
    )


def steep() -> eg.Mesh:
    """A floor that begins close to the camera and goes far away, in small faces."""
    n = 12
    u, v = torch.meshgrid(*2 * [torch.linspace(0, 1, n, dtype=F64)], indexing="ij")
    pixels = torch.stack([48 * u + 3 * v, 20 + 28 * v * v], -1).reshape(-1, 2)
    depth = (0.4 / (0.03 + v)).reshape(-1)
    k = torch.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]
    faces = torch.cat([torch.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    verts = unproject(CAMERA, pixels, depth)
    return eg.Mesh(verts, faces, colors=random_colors(n * n))


SCENES = {
    "sphere": lambda: [icosphere(3)],
    "behind bars": lambda: [icosphere(3), bars()],
    "faces apart": lambda: [apart(icosphere(3)), bars(10)],
    "turned away": lambda: [icosphere(3), turned_away()],
    "steep": lambda: [steep()],
    "one colour a face": lambda: [icosphere(2).replace(colors=None, face_colors=random_colors(320))],
}


class Gradient:
    """The interior term for the colours and for a few motions that no control was made for."""

    def __init__(self, meshes: list[eg.Mesh], adjoint: Tensor) -> None:
        self.meshes, self.adjoint = meshes, adjoint
        random = torch.Generator().manual_seed(5)
        self.colored = [next(f for f in ("colors", "face_colors") if getattr(m, f) is not None) for m in meshes]
        self.directions = [torch.randn(3, *m.verts.shape, generator=random, dtype=F64) for m in meshes]
        self.paints = [
            torch.randn(3, *getattr(m, f).shape, generator=random, dtype=F64)
            for m, f in zip(meshes, self.colored, strict=True)
        ]

    def __call__(self, render: Callable[[eg.Scene, eg.Camera], Tensor]) -> Tensor:
        verts = [m.verts.clone().requires_grad_() for m in self.meshes]
        colors = [
            getattr(m, f).clone().requires_grad_() for m, f in zip(self.meshes, self.colored, strict=True)
        ]  # fmt: skip
        K, pose = (t.clone().requires_grad_() for t in (CAMERA.K, CAMERA.world_to_camera))
        scene = eg.Scene(
            [m.replace(verts=v, **{f: c}) for m, f, v, c in zip(self.meshes, self.colored, verts, colors, strict=True)]
        )
        image = render(scene, CAMERA.replace(K=K, world_to_camera=pose))
        leaves = [*verts, *colors, K, pose]
        grads = torch.autograd.grad(image, leaves, self.adjoint, allow_unused=True, materialize_grads=True)
        n = len(verts)
        motions = sum((d * g).sum((1, 2)) for d, g in zip(self.directions, grads[:n], strict=True))
        paints = sum((d * g).sum((1, 2)) for d, g in zip(self.paints, grads[n : 2 * n], strict=True))
        return torch.cat([motions, paints, grads[-2][:2].reshape(-1), grads[-1][:3].reshape(-1)])  # type: ignore[list-item]


@pytest.mark.parametrize(("name", "rough", "filter"), diagonal(list(SCENES), [False, True], ["box", "gaussian"]))
def test_few_samples_estimate_what_is_exact(name: str, rough: bool, filter: str) -> None:
    """Few samples, mostly control, after images of one sample a pixel, which decide where there is a control; against exact
    integrals, which have none."""
    adjoint = smooth_adjoint(48, 48, 3)
    if rough:
        adjoint = torch.randn(48, 48, 3, generator=torch.Generator().manual_seed(3), dtype=F64)
    gradient = Gradient(SCENES[name](), adjoint)
    few = partial(eg.render, spp=1, seed=0, sampling=eg.Sampling(surface=400), filter=filter, visibility=False)
    found = torch.stack([gradient(partial(few, seed=seed)) for seed in range(40)])
    exact = gradient(partial(exact_image, order=8, filter=filter, visibility=False))
    error = found.std(0) / len(found) ** 0.5
    z = (found.mean(0) - exact) / (error + 1e-7 * exact.abs().max())  # the Gauss rule's error
    assert z.abs().max() < 4.5, z


def test_a_smooth_loss_needs_few_samples() -> None:
    """The error was 11 % without the control, with three times the samples."""
    mesh, adjoint = icosphere(4), smooth_adjoint(96, 96, 3)
    camera = front_camera(96)

    def interior(seed: int, **options: int) -> Tensor:
        verts = mesh.verts.clone().requires_grad_()
        image = eg.render(mesh.replace(verts=verts), camera, seed=seed, visibility=False, **options)
        return torch.autograd.grad(image, verts, adjoint)[0]

    samples, _ = default_samples(mesh, camera, adjoint)
    assert samples < 0.5 * eg.plan(mesh.replace(verts=mesh.verts.clone().requires_grad_()), camera)["interior"].samples
    true = interior(9, sampling=eg.Sampling(surface=400_000))
    error = torch.stack([(interior(seed) - true).norm() for seed in range(6)]).square().mean().sqrt()
    assert error < 0.045 * true.norm()


@pytest.mark.parametrize("signs", [False, True])
def test_a_rough_loss_gets_its_samples(signs: bool) -> None:
    """Corners say little of what is between them where neighbouring pixels are independent. They say less where they agree by
    chance, as the signs of an L1 loss do: then a face was sampled a sixteenth as often, error × 3."""
    mesh, camera = icosphere(4), front_camera(64)
    assert mesh.colors is not None
    mesh = mesh.replace(colors=mesh.colors[:, :1])
    rough = torch.randn(64, 64, 1, generator=torch.Generator().manual_seed(3), dtype=F64)
    rough = rough.sign() if signs else rough
    smooth, many = (default_samples(mesh, camera, a)[0] for a in (smooth_adjoint(64, 64, 1), rough))
    assert many > 1.8 * smooth

    def interior(seed: int, **options: int) -> Tensor:
        verts = mesh.verts.clone().requires_grad_()
        image = eg.render(mesh.replace(verts=verts), camera, seed=seed, visibility=False, **options)
        return torch.autograd.grad(image, verts, rough)[0]

    true = interior(9, sampling=eg.Sampling(surface=200_000))
    error = torch.stack([(interior(seed) - true).norm() for seed in range(8)]).square().mean().sqrt()
    assert error < 1.5 * true.norm()  # 1.1 without a control; rough is rough


def test_hardly_any_samples() -> None:
    """One sample for twenty thousand faces: the control tells the gradient nearly alone, and the sample does not spoil it."""
    mesh, camera, adjoint = icosphere(5), front_camera(64), smooth_adjoint(64, 64, 3)

    def depth(samples: int, seed: int) -> Tensor:
        verts = mesh.verts.clone().requires_grad_()
        image = eg.render(
            mesh.replace(verts=verts),
            camera,
            visibility=False,
            sampling=eg.Sampling(surface=samples, seed=seed),
            seed=0,
        )
        return torch.autograd.grad(image, verts, adjoint)[0].sum(0)

    true = depth(200_000, 0)
    error = torch.stack([(depth(1, seed) - true).norm() for seed in range(9)]).median()
    assert error < 0.25 * true.norm()


def coloured_grid(n: int, height: Callable[[Tensor, Tensor], Tensor], seed: int) -> eg.Mesh:
    """A grid of n × n squares of two triangles over [−1.5, 1.5]², with a colour for each."""
    y, x = torch.meshgrid(*[torch.linspace(-1.5, 1.5, n + 1, dtype=F64)] * 2, indexing="ij")
    generator = torch.Generator().manual_seed(seed)
    noise = 0.05 / n * torch.randn(((n + 1) ** 2, 3), generator=generator, dtype=F64)
    verts = torch.stack([x, y, height(x, y)], -1).reshape(-1, 3) + noise
    corner = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1, 1)
    faces = (corner + torch.tensor([0, 1, n + 2, 0, n + 2, n + 1])).reshape(-1, 3)
    return eg.Mesh(verts, faces, face_colors=torch.rand((len(faces), 3), generator=generator, dtype=F64))


def coloured_sphere(subdivisions: int) -> eg.Mesh:
    ball = icosphere(subdivisions)
    colors = torch.rand((len(ball.faces), 3), generator=torch.Generator().manual_seed(6), dtype=F64)
    return eg.Mesh(ball.verts.to(F64), ball.faces, face_colors=colors)


def through_itself() -> eg.Mesh:
    """A small sphere that comes out of a large one, with which it shares one vertex: one connected part."""
    large, small = (
        coloured_sphere(3),
        coloured_sphere(3).transformed(scale=0.4, t=torch.tensor([0.3, 0.2, 0.8], dtype=F64)),
    )
    faces = small.faces + len(large.verts)
    link = (large.verts - small.verts[0]).norm(dim=1).argmin().to(faces.dtype)
    faces = torch.where(faces == len(large.verts), link, faces)
    assert large.face_colors is not None and small.face_colors is not None
    return eg.Mesh(
        torch.cat([large.verts, small.verts]),
        torch.cat([large.faces, faces]),
        face_colors=torch.cat([large.face_colors, small.face_colors]),
    )


# Creases all of which are visible or hidden; such that another mesh passes through them, where no silhouette tells; and the
# creases of a sheet seen flat, which its own bumps hide.
CREASES = {
    "a sphere": ([coloured_sphere(4)], (0.3, -0.2, 3.5), 0.008),
    "a sphere in a sheet": ([coloured_sphere(3), coloured_grid(10, lambda x, y: 0 * x, 1)], (0.3, -0.2, 3.5), 0.005),
    "two sheets": (
        [coloured_grid(20, lambda x, y: 0 * x, 2), coloured_grid(23, lambda x, y: 0.3 * x + 0.013 * y + 0.006, 3)],
        (0.3, -0.2, -3.5), 0.02,
    ),
    "a part through itself": ([through_itself()], (0.3, -0.2, 3.5), 0.02),
    "waves, seen flat": ([coloured_grid(20, lambda x, y: 0.1 * torch.sin(9 * x), 4)], (3.0, -0.2, 0.6), 0.03),
}  # fmt: skip


@pytest.mark.parametrize("name", CREASES)
def test_default_samples_at_creases(name: str) -> None:
    """Few samples where all of a crease is visible or none, and all of them where that may not be so: if nobody asks where parts
    meet, the error of the two sheets is 34 %, and if nobody asks for silhouettes, that of the waves is 56 %."""
    meshes, eye, most = CREASES[name]
    camera = eg.Camera.look_at(eye, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 45.0, (96, 96)).to(F64)
    adjoint = smooth_adjoint(96, 96, 3).to(F64)

    def gradient(render: Callable[[eg.Scene], Tensor]) -> Tensor:
        verts = [mesh.verts.clone().requires_grad_() for mesh in meshes]
        image = render(eg.Scene([mesh.replace(verts=v) for mesh, v in zip(meshes, verts, strict=True)]))
        return torch.cat(torch.autograd.grad((image * adjoint).sum(), verts))

    def estimate(seed: int, edge_samples: int | None = None) -> Tensor:
        return gradient(
            lambda scene: eg.render(scene, camera, sampling=eg.Sampling(seed=seed, edges=edge_samples), seed=0)
        )

    if name in ("a sphere", "waves, seen flat"):
        true = gradient(lambda scene: exact_image(scene, camera))
    else:  # no exact image of what passes through each other
        true = (estimate(1000, 1_000_000) + estimate(1001, 1_000_000)) / 2
    errors = torch.stack([(estimate(seed) - true).norm() / true.norm() for seed in range(8)])
    assert float(errors.square().mean().sqrt()) < most, errors


def test_hidden_creases_seen_through_a_gap() -> None:
    """A hole of half a pixel, which one ray a pixel misses every other time: then what lies behind it was not hit, and only its
    border tells that it may be seen."""
    ball = coloured_sphere(3)
    corner = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=F64)
    verts = torch.cat([torch.cat([size * corner, torch.full((4, 1), 1.3, dtype=F64)], 1) for size in (2.0, 0.03)])
    quads = torch.tensor([[i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)])
    faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    wall = eg.Mesh(verts, faces, colors=torch.full((8, 3), 0.5, dtype=F64))
    camera = eg.Camera.look_at((0.3, -0.2, 3.5), (0.0, 0.0, 1.3), (0.0, 1.0, 0.0), 45.0, (16, 16)).to(F64)
    adjoint = smooth_adjoint(16, 16, 3).to(F64)

    def gradient(**options: int) -> Tensor:
        moved = ball.verts.clone().requires_grad_()
        image = eg.render(eg.Scene([ball.replace(verts=moved), wall]), camera, **{"seed": 0, **options})
        (found,) = torch.autograd.grad((image * adjoint).sum(), [moved])
        return found

    true = gradient(spp=256, sampling=eg.Sampling(edges=1_000_000))
    found = torch.stack(
        [gradient(spp=1, seed=seed, sampling=eg.Sampling(seed=seed, edges=100_000)) for seed in range(24)]
    )
    assert float((found.mean(0) - true).norm()) < 0.1 * float(true.norm())


def test_creases_that_something_hides() -> None:
    """Slats before the creases of a grid with a colour for each face: the vertices around were hit, the creases were not.
    With few samples on them, because their control takes them for visible, the error was 60 %."""
    n, generator = 8, torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(*[torch.linspace(-1.0, 1.0, n + 1, dtype=F64)] * 2, indexing="ij")
    noise = 0.005 * torch.randn(((n + 1) ** 2, 3), generator=generator, dtype=F64)
    verts = torch.stack([x, y, 0 * x], -1).reshape(-1, 3) + noise
    corner = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1, 1)
    faces = (corner + torch.tensor([0, 1, n + 2, 0, n + 2, n + 1])).reshape(-1, 3)
    grid = eg.Mesh(verts, faces, face_colors=torch.rand((len(faces), 3), generator=generator, dtype=F64))
    scene = [grid]
    for row in torch.linspace(-1.0, 1.0, n + 1)[1:-1].tolist():
        slat = [[-1.2, row - 0.09, -0.2], [1.2, row - 0.088, -0.2], [1.2, row + 0.09, -0.2], [-1.2, row + 0.088, -0.2]]
        scene.append(eg.Mesh(torch.tensor(slat, dtype=F64), torch.tensor([[0, 1, 2], [0, 2, 3]])))
    camera = eg.Camera.look_at((0.03, 0.02, -3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 45.0, (64, 64)).to(F64)
    adjoint = torch.linspace(0.0, 1.0, 64, dtype=F64)[:, None, None].expand(64, 64, 3)

    def gradient(render) -> torch.Tensor:
        moving = verts.clone().requires_grad_()
        image = render(eg.Scene([grid.replace(verts=moving), *scene[1:]]))
        return torch.autograd.grad((image * adjoint).sum(), moving)[0]

    exact = gradient(lambda scene: exact_image(scene, camera))
    found = [gradient(lambda scene, seed=seed: eg.render(scene, camera, seed=seed)) for seed in range(8)]
    errors = torch.stack([(g - exact).norm() / exact.norm() for g in found])
    assert float(errors.square().mean().sqrt()) < 0.05, errors


def test_a_crease_next_to_a_face_that_is_seen_edge_on() -> None:
    """Rays, placed in float, slip past a face that is a hundred-thousandth of a pixel wide, and see the crease behind it. It must
    not be taken for visible: what samples then take away again is 0.6 % of the whole gradient, in one seed of two."""
    scene = build("flat-colors")
    behind, adjacent = 43, 10492  # the crease's vertices
    for seed in range(6):
        gradient, *_ = differentiate(scene, spp=16, seed=seed)
        assert float(gradient[adjacent].norm()) > 0
        assert float(gradient[behind].norm() / gradient.norm()) < 1e-3
