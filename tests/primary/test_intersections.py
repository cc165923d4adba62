"""Lines where faces pass through each other: which there are, against exhaustion, and gradients along them, against exact
images of the faces cut apart (tests/oracles/cut_apart.py) and against finite differences."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from combinations import diagonal
from finite_differences import check, check_ratio, estimate, rotation
from kernel_parts import parts
from oracles.cut_apart import cut_apart, faces_that_cross
from oracles.exact import exact_image
from scenes import cube, front_camera, icosphere, smooth_adjoint, smooth_colors, soup
from torch import Tensor

import edgegrad as eg
from edgegrad.library import core

F64 = torch.float64
BACKGROUND = torch.tensor([0.15, 0.25, 0.4], dtype=F64)
ALONG = torch.tensor([0.7, 0.6, -0.2], dtype=F64)
PROJECTIONS = ("perspective", "orthographic")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def joined(*meshes: eg.Mesh) -> tuple[Tensor, Tensor]:
    """Vertices and faces of all."""
    first = [sum(len(mesh.verts) for mesh in meshes[:k]) for k in range(len(meshes))]
    return torch.cat([m.verts for m in meshes]), torch.cat([m.faces + k for m, k in zip(meshes, first, strict=True)])


def found(verts: Tensor, faces: Tensor, *, threads: int = 1, windings: Tensor | None = None, share=None, seed: int = 0):
    """(face, face, end, end) of each; for how many each stands; and whether they are drawn, by the share (F,) of each face."""
    windings = faces if windings is None else windings
    share = torch.ones(len(faces)) if share is None else share
    arrays = verts.double().numpy(), faces.int().numpy(), windings.int().numpy()
    spacing = torch.finfo(verts.dtype).eps
    pairs, drawn = parts.intersections(*arrays, spacing, share.numpy(), seed, threads)
    return [pair[:4] for pair in pairs], torch.tensor([pair[4] for pair in pairs], dtype=F64), drawn


# -- which there are --------------------------------------------------------------------------------------------------


def random_triangles(n: int, seed: int, size: float = 1.0) -> tuple[Tensor, Tensor]:
    middle = torch.rand((n, 1, 3), generator=generator(seed), dtype=F64)
    verts = middle + size * (torch.rand((n, 3, 3), generator=generator(seed + 1), dtype=F64) - 0.5)
    return verts.reshape(-1, 3), torch.arange(3 * n).reshape(n, 3)


def tangle() -> tuple[Tensor, Tensor]:
    ball = icosphere(2)
    return ball.verts + 0.16 * torch.randn(ball.verts.shape, generator=generator(), dtype=F64), ball.faces


@pytest.mark.parametrize("scene", [random_triangles(300, 1), random_triangles(600, 2, 0.4), tangle()])
def test_pairs_against_exhaustion(scene):
    verts, faces = scene
    corners = verts[faces]
    expected = torch.nonzero(torch.triu(faces_that_cross(corners))).tolist()
    pairs, stands_for, drawn = found(verts, faces)
    assert not drawn and bool((stands_for == 1).all()) and len(expected) > 50
    assert [list(pair[:2]) for pair in pairs] == expected
    assert found(verts, faces, threads=3)[0] == pairs
    for f, g, *ends in pairs:  # on both planes, and no point
        for face in (f, g):
            origin, p, q = corners[face]
            normal = torch.nn.functional.normalize(torch.linalg.cross(p - origin, q - origin), dim=0)
            assert all(abs(float(normal @ (torch.tensor(end, dtype=F64) - origin))) < 1e-9 for end in ends)
        assert ends[0] != ends[1]


def sheet(n: int, m: int, closed: bool, place) -> tuple[Tensor, Tensor]:
    """A grid of n x m cells at place(u, v) in [0, 1)², closed in both directions or in none."""
    i = torch.arange(n)[:, None].expand(n, m).reshape(-1)
    k = torch.arange(m)[None, :].expand(n, m).reshape(-1)
    rows, columns = (n, m) if closed else (n + 1, m + 1)

    def at(i: Tensor, k: Tensor) -> Tensor:
        return (i % rows) * columns + k % columns

    quads = [at(i, k), at(i + 1, k), at(i + 1, k + 1), at(i, k + 1)]
    faces = torch.cat([torch.stack([quads[c] for c in half], 1) for half in ((0, 1, 2), (0, 2, 3))])
    u, v = torch.meshgrid(torch.arange(rows) / n, torch.arange(columns) / m, indexing="ij")
    return torch.stack(place(u.double().reshape(-1), v.double().reshape(-1)), 1), faces


def torus(wave: float, times: int) -> tuple[Tensor, Tensor]:
    """Whose tube is as thick as its hole is wide, but for waves of it."""
    turn = 2 * torch.pi

    def place(u: Tensor, v: Tensor) -> list[Tensor]:
        tube = 0.5 + wave * torch.sin(times * turn * u) * torch.cos(times * turn * v)
        ring = 0.5 + tube * torch.cos(turn * v)
        return [ring * torch.cos(turn * u), ring * torch.sin(turn * u), tube * torch.sin(turn * v)]

    return sheet(160, 80, True, place)


def spiral(rise: float) -> tuple[Tensor, Tensor]:
    """A ramp of two turns whose width rises, so that at the outside the lower turn reaches the upper one. All of it faces
    up, and only its outline says that it passes through itself."""

    def place(u: Tensor, v: Tensor) -> list[Tensor]:
        angle, radius = 4 * torch.pi * u, 0.4 + v
        return [radius * torch.cos(angle), radius * torch.sin(angle), 0.2 * u + rise * v * (1 - u) ** 2]

    return sheet(400, 40, False, place)


def shells(apart: float, wave: float) -> tuple[Tensor, Tensor]:
    """Two spheres one within the other, as near as their waves or farther."""
    ball = icosphere(5)
    waves = 1 + wave * torch.sin(20 * ball.verts[:, :1]) * torch.sin(17 * ball.verts[:, 1:2])
    inner = ball.replace(verts=(1 - apart) * ball.verts)
    return joined(ball.replace(verts=ball.verts * waves), inner)


def split(verts: Tensor, faces: Tensor, every: int = 7) -> tuple[Tensor, Tensor]:
    """The same surface with vertices of its own for each block of faces, as along the seams of a texture."""
    block = torch.arange(len(faces)) * every // len(faces)
    keys, index = torch.unique(
        torch.stack([faces, block[:, None].expand(-1, 3)], -1).reshape(-1, 2), dim=0, return_inverse=True
    )
    return verts[keys[:, 0]], index.reshape(-1, 3)


SMOOTH = {
    "torus": torus(0.0, 1),
    "torus with waves": torus(0.05, 3),
    "a rough torus": torus(0.005, 20),
    "spiral": spiral(0.0),
    "spiral through itself": spiral(0.25),
    "spheres": joined(icosphere(5), (other := icosphere(4)).replace(verts=0.8 * other.verts + 0.4)),
    "shells": shells(0.002, 0.001),
    "shells through each other": shells(0.002, 0.004),
    "texture seams": split(*shells(0.002, 0.004)),
    "far away": ((scene := shells(0.01, 0.02))[0] + 30.0, scene[1]),
    "large beside small": joined(icosphere(5), (other := icosphere(1)).replace(verts=40 * other.verts + 40.2)),
}


# Those of them that pass through something.
THROUGH = set(SMOOTH) - {"torus", "spiral", "shells", "large beside small"}


@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("turned", [pytest.param(0.0, marks=pytest.mark.slow), 1.0])
def test_height_fields_hide_no_pair(name, turned):
    """Where a closed surface is a height field no pairs are compared. With every second face turned round there is no
    surface that goes on, so all are; and which faces pass through each other is the same."""
    verts, faces = SMOOTH[name]
    verts = (verts @ rotation((0.48, -0.6, 0.64), torch.tensor(turned)).T).float()
    reversed_faces = torch.where(torch.arange(len(faces))[:, None] % 2 == 0, faces, faces.flip(1))
    pairs, stands_for, _ = found(verts, faces)
    assert pairs == found(verts, faces, windings=reversed_faces)[0] and bool((stands_for == 1).all())
    assert bool(pairs) == (name in THROUGH)


def on_the_ground(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """A box that stands on a sheet, both turned by what leaves rounding."""
    box = soup(cube(0.5)).transformed(t=torch.tensor([0.1, 0.5, 0.2], dtype=F64))
    sheet = eg.Mesh(
        torch.tensor([[-2.0, 0.0, -2.0], [2.0, 0.0, -2.0], [0.0, 0.0, 3.0]], dtype=F64), torch.tensor([[0, 1, 2]])
    )
    verts, faces = joined(box, sheet)
    return verts.to(dtype) @ rotation((0.48, 0.6, 0.64), torch.tensor(0.7, dtype=F64)).to(dtype).T, faces


TOUCHING = {
    "a closed sphere": (icosphere(3).verts, icosphere(3).faces),
    "a box on a sheet": on_the_ground(F64),
    "a box on a sheet in float32": on_the_ground(torch.float32),
    "a vertex on a face": (
        torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [0, 0, 0], [0.3, 0, 1], [-0.3, 0.1, 1]], dtype=F64),
        torch.tensor([[0, 1, 2], [3, 4, 5]]),
    ),
    "an edge in a face, both its faces above": (
        torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [-0.2, 0, 0], [0.2, 0, 0], [0, 1, 1], [0, -1, 1]], dtype=F64),
        torch.tensor([[0, 1, 2], [3, 4, 5], [4, 3, 6]]),
    ),
    "a sheet through an open edge": (
        torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [-0.2, -1, -1], [0.2, -1, -1], [0, -1, 1]], dtype=F64),
        torch.tensor([[0, 1, 2], [3, 4, 5]]),
    ),
    "two in one plane": (
        torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [-0.5, 0.2, 0], [0.9, 0.3, 0], [0, -2, 0]], dtype=F64),
        torch.tensor([[0, 1, 2], [3, 4, 5]]),
    ),
    "without area": (
        torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1], [0, 0, 0.5]], dtype=F64),
        torch.tensor([[0, 1, 2], [3, 4, 5], [3, 3, 4], [5, 5, 5]]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TOUCHING)
def test_what_touches_does_not_pass_through(name):
    assert found(*TOUCHING[name])[0] == []


def large_tangle(copies: int = 1) -> tuple[Tensor, Tensor]:
    """24,671 pairs of faces; with copies of all faces."""
    ball = icosphere(5)
    verts = ball.verts + 0.03 * torch.randn(ball.verts.shape, generator=generator(), dtype=F64)
    return torch.cat([verts] * copies), torch.cat([ball.faces + k * len(verts) for k in range(copies)])


@pytest.mark.slow
def test_many_pairs_are_drawn():
    """Each pair with the product of the probabilities of its faces, for as many as there are."""
    verts, faces = large_tangle()
    pairs, stands_for, drawn = found(verts, faces)
    assert drawn and bool((stands_for == 1).all()) and len(pairs) == 24_671
    share = torch.where(torch.rand(len(faces), generator=generator(1)) < 0.3, 1.0, 0.5)
    totals = []
    for seed in range(16):
        some, stands_for, drawn = found(verts, faces, share=share, seed=seed)
        assert drawn and len(some) < 0.5 * len(pairs) and {pair[:2] for pair in some} <= {pair[:2] for pair in pairs}
        f, g = torch.tensor([pair[:2] for pair in some]).T
        assert torch.equal(stands_for, 1 / (share[f] * share[g]).double())
        totals.append(float(stands_for.sum()))
    check("pairs", len(pairs), estimate(totals))
    assert found(verts, faces, share=share, seed=seed, threads=3)[0] == some


@pytest.mark.slow
def test_copies_share_what_is_drawn():
    """Whichever of them are."""
    pairs = len(found(*large_tangle())[0])
    share = torch.where(torch.rand(2 * 20480, generator=generator(1)) < 0.3, 1.0, 0.5)
    totals = []
    for seed in range(8):
        some, stands_for, drawn = found(*large_tangle(2), share=share, seed=seed)
        assert drawn and len(some) < 2 * pairs  # of four times as many
        totals.append(float(stands_for.sum()))
    check("pairs", pairs, estimate(totals))


@pytest.mark.parametrize(
    ("copies", "apart"), [(2, False), (2, True), *(pytest.param(1, a, marks=pytest.mark.slow) for a in (False, True))]
)
def test_one_side_of_an_edge_in_a_face_is_drawn_without_the_other(copies, apart):
    """A roof whose ridge lies in a sheet, next to a tangle. The other side of the ridge is mostly hidden, and counts no less."""
    verts = torch.tensor(
        [[-2, -2, 0], [2, -2, 0], [0, 3, 0], [0, -0.5, 0], [0, 0.5, 0], [-1, 0, -1], [1, 0, 1]], dtype=F64
    )
    faces = torch.tensor([[0, 1, 2], [3, 4, 5], [4, 3, 6]])
    assert float(found(verts, faces)[1].sum()) == 1
    sheets = [(verts, faces)] * (copies if apart else 1)
    roof = torch.cat([v for v, _ in sheets]), torch.cat([f + len(verts) * k for k, (_, f) in enumerate(sheets)])
    if not apart:
        roof = verts, torch.cat([faces, *[faces[1:]] * (copies - 1)])
    ball = icosphere(4)
    noise = torch.randn(ball.verts.shape, generator=generator(), dtype=F64)
    tangle = ball.verts + 0.08 * noise + torch.tensor([100.0, 0.0, 0.0], dtype=F64)
    both = torch.cat([roof[0], tangle]), torch.cat([roof[1], ball.faces + len(roof[0])])
    of_roof = len(roof[1])
    for never, expected in (([], 1.0), ([2], 1.0), ([1, 2], 1 - 1 / copies)):
        share = torch.ones(len(both[1]))
        share[never] = 1e-9
        pairs, stands_for, drawn = found(*both, share=share)
        on_roof = torch.tensor([max(pair[:2]) < of_roof for pair in pairs])
        assert drawn and float(stands_for[on_roof].sum()) == pytest.approx(expected, abs=1e-6)


def test_so_many_pairs_that_only_some_are_found():
    """A soup of large triangles: as many as the square of its faces."""
    fraction = {}
    for n in (1200, 4000):
        pairs, stands_for, drawn = found(*random_triangles(n, 5))
        assert drawn == (n == 4000) and (not drawn or len(pairs) < 25_000)
        fraction[n] = float(stands_for.sum()) / n**2
    assert abs(fraction[4000] / fraction[1200] - 1) < 0.05


def ring_in_a_sheet(seed: int, away: float) -> tuple[Tensor, Tensor]:
    """A box with a ring of edges that lies in a sheet, turned at random and moved so far away, rounded to floats."""
    ring = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=F64)
    box = torch.cat([torch.cat([ring, torch.full((4, 1), z, dtype=F64)], 1) for z in (-1.0, 0.0, 1.0)])
    sides = [[k + i, k + (i + 1) % 4, k + i + 4] for k in (0, 4) for i in range(4)]
    sides += [[k + (i + 1) % 4, k + (i + 1) % 4 + 4, k + i + 4] for k in (0, 4) for i in range(4)]
    at = torch.linspace(-3, 3, 5, dtype=F64)
    sheet = torch.cat([torch.cartesian_prod(at, at), torch.zeros(25, 1, dtype=F64)], 1)
    cells = torch.tensor([5 * j + i for j in range(4) for i in range(4)])[:, None]
    quads = torch.cat([cells + torch.tensor([0, 5, 6]), cells + torch.tensor([0, 6, 1])])
    turn = torch.linalg.qr(torch.randn((3, 3), generator=generator(seed), dtype=F64))[0]
    verts = torch.cat([box, sheet]) @ turn.T + away * torch.tensor([0.37, 0.61, 0.7], dtype=F64)
    return verts.float(), torch.cat([torch.tensor(sides), quads + len(box)])


def test_edges_in_a_sheet_are_found_wherever_they_are():
    """Floats put them a little before it or behind, the more the farther away from the origin: by spacings of theirs, which is
    far more than what is left of a face's own size. Most of them were lost 1,000 sizes away."""
    near, far = ([len(found(*ring_in_a_sheet(seed, away))[0]) for seed in range(24)] for away in (0.0, 1000.0))
    assert min(near) >= 24
    assert sum(f != n for f, n in zip(far, near, strict=True)) <= 2


# -- gradients against exact images -----------------------------------------------------------------------------------


def roof() -> tuple[Tensor, Tensor]:
    """A triangle through the edge between two faces."""
    verts = torch.tensor(
        [
            [-0.6, 0.1, 0.2], [0.7, -0.1, 0.3], [0.1, 0.7, -0.5], [-0.1, -0.8, -0.4],
            [0.5, 0.5, 0.9], [-0.4, 0.0, -0.8], [0.45, -0.45, 0.3],
        ],
        dtype=F64,
    )  # fmt: skip
    return verts, torch.tensor([[0, 1, 2], [1, 0, 3], [4, 5, 6]])


def at_a_vertex() -> tuple[Tensor, Tensor]:
    """Two faces that share a vertex and meet along a segment from it."""
    verts = torch.tensor(
        [[-0.7, 0.1, 0.2], [0.7, 0.6, 0.3], [0.6, -0.6, 0.1], [0.4, 0.2, 0.9], [0.5, -0.15, -0.8]], dtype=F64
    )
    return verts, torch.tensor([[0, 1, 2], [0, 3, 4]])


SCENES = {
    "two": random_triangles(2, 14, 1.5),
    "three, through one point": random_triangles(3, 15, 2.0),
    "eight": random_triangles(8, 13, 1.5),
    "through an edge": roof(),
    "at a vertex": at_a_vertex(),
}


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("name", SCENES)
def test_gradient_against_the_exact_one(name, projection):
    """Of all vertices and of the camera, each relative to its own size, and the intersections matter."""
    verts, faces = SCENES[name]
    verts = verts - (verts.mean(0) if name in ("two", "three, through one point", "eight") else 0)
    camera, adjoint = front_camera(32, projection), smooth_adjoint(32, 32, 3).to(F64)
    colors = torch.rand((len(verts), 3), generator=generator(4), dtype=F64)
    assert len(found(verts, faces)[0]) >= {"three, through one point": 3, "eight": 8, "through an edge": 2}.get(name, 1)

    def gradient(image) -> list[Tensor]:
        leaves = [t.clone().requires_grad_() for t in (verts, camera.world_to_camera, camera.K)]
        scene = eg.Scene([eg.Mesh(leaves[0], faces, colors=colors)], BACKGROUND)
        loss = (image(scene, camera.replace(world_to_camera=leaves[1], K=leaves[2])) * adjoint).sum()
        grads = torch.autograd.grad(loss, leaves)
        return [grads[0], grads[1][:3], grads[2][:2]]

    true = gradient(lambda scene, camera: exact_image(cut_apart(scene), camera))
    options: dict[str, Any] = {"surface_samples": 50_000, "edge_samples": 50_000}
    estimates = [gradient(lambda s, c, k=k: eg.render(s, c, seed=k, **options)) for k in range(4)]
    for k, exact in enumerate(true):
        mean = torch.stack([e[k] for e in estimates]).mean(0)
        assert float((mean - exact).norm()) < 0.004 * float(exact.norm())


# -- gradients against finite differences -----------------------------------------------------------------------------

SAMPLES: dict[str, Any] = {"surface_samples": 20_000, "edge_samples": 20_000}


@pytest.mark.parametrize(("dtype", "projection"), diagonal([torch.float32, F64], PROJECTIONS))
def test_boxes_through_each_other(projection, dtype):
    """0.20 in another renderer: it had no edge there. Two meshes, of which one moves."""
    box = cube(0.45).transformed(rotation((0.6, 0.0, 0.8), torch.tensor(0.4, dtype=F64)))
    other = box.transformed(
        rotation((0.0, 1.0, 0.0), torch.tensor(0.9, dtype=F64)), torch.tensor([0.35, 0.2, 0.15], dtype=F64)
    )

    assert other.colors is not None
    other = other.replace(colors=1 - other.colors)

    def one_moves(theta: Tensor):
        moved = box.transformed(t=theta * ALONG)
        return eg.Scene([moved.to(dtype), other.to(dtype)], BACKGROUND), camera

    camera = front_camera(48, projection)
    check_ratio(one_moves, 0.006, spp=2048, **SAMPLES)


@pytest.mark.parametrize("mesh", [pytest.param("itself", marks=pytest.mark.slow), "another"])
def test_a_sphere_sunk_to_edges_that_lie_in_a_sheet(mesh):
    """Of an icosphere a third of its equator are edges. Which of their two faces passes through the sheet depends on the
    direction of the motion, so the gradient is the mean."""
    ball = icosphere(2).transformed(scale=0.7)
    corners = torch.tensor([[-1.2, -1.1, 0.0], [1.2, -1.0, 0.0], [1.1, 1.2, 0.0], [-1.1, 1.0, 0.0]], dtype=F64)
    colors = torch.tensor([[0.9, 0.1, 0.1], [0.8, 0.3, 0.1], [0.7, 0.1, 0.2], [0.9, 0.3, 0.3]], dtype=F64)
    sheet = eg.Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), colors=colors)
    camera = eg.Camera.look_at((1.4, 1.9, 2.6), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (64, 64)).to(F64)
    assert ball.colors is not None
    both = eg.Mesh(*joined(ball, sheet), colors=torch.cat([ball.colors, colors]))

    def shifted(theta: Tensor):
        if mesh == "itself":
            return eg.Scene([both.transformed(t=theta * ALONG)], BACKGROUND), camera
        return eg.Scene([ball.transformed(t=theta * ALONG), sheet.transformed(t=theta * ALONG)], BACKGROUND), camera

    check_ratio(shifted, 0.006, spp=384, **SAMPLES)

    def sunk(theta: Tensor):
        t = theta * torch.tensor([0.0, 0.0, 1.0], dtype=F64)
        return eg.Scene([ball.transformed(t=t), sheet], BACKGROUND), camera

    check_ratio(sunk, 0.003, spp=768, **SAMPLES)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_face_seen_edge_on_contributes_nothing(projection):
    """A blade through a sheet whose plane holds the eye: it has no image, and its line no gradient that is not finite."""
    verts = torch.tensor(
        [[-1.0, -1, 0], [1, -1, 0], [0, 1.3, 0], [0, -0.4, -0.5], [0, -0.3, 0.5], [0, 0.5, 0.1]], dtype=F64
    )
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    world_to_camera = torch.eye(4, dtype=F64)
    world_to_camera[2, 3] = 3.0
    K = torch.tensor([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]], dtype=F64)
    K[:2, :2] /= 1 if projection == "perspective" else 3
    camera = eg.Camera(world_to_camera, K, (32, 32), projection)

    def gradient(verts: Tensor, faces: Tensor) -> Tensor:
        verts = verts.clone().requires_grad_()
        mesh = eg.Mesh(verts, faces, colors=torch.arange(3.0 * len(verts), dtype=F64).reshape(-1, 3) / 10)
        image = eg.render(mesh, camera, seed=1)
        return torch.autograd.grad(image, verts, smooth_adjoint(32, 32, 3))[0]

    assert [pair[:2] for pair in found(verts, faces)[0]] == [(0, 1)]
    with_blade, alone = gradient(verts, faces), gradient(verts[:3], faces[:1])
    assert bool(with_blade.isfinite().all())
    assert float((with_blade[:3] - alone).norm()) < 0.02 * float(alone.norm())


def test_copies_share_the_line():
    """A box listed twice by index, or three times by place, through another: the line between them is there once."""
    box = cube(0.45).transformed(rotation((0.6, 0.0, 0.8), torch.tensor(0.4, dtype=F64)))
    other = box.transformed(
        rotation((0.0, 1.0, 0.0), torch.tensor(0.9, dtype=F64)), torch.tensor([0.35, 0.2, 0.15], dtype=F64)
    )
    assert other.colors is not None
    other = other.replace(colors=1 - other.colors)
    twice = box.replace(faces=torch.cat([box.faces, box.faces[:, [1, 2, 0]]]))
    camera, adjoint = front_camera(48), smooth_adjoint(48, 48, 3).to(F64)

    def slope(*meshes: eg.Mesh) -> Tensor:
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        scene = eg.Scene([*(mesh.transformed(t=theta * ALONG) for mesh in meshes), other], BACKGROUND)
        return torch.autograd.grad((eg.render(scene, camera, **SAMPLES) * adjoint).sum(), theta)[0]

    once = slope(box)
    for meshes in ([twice], [box, box, box]):
        torch.testing.assert_close(slope(*meshes), once, rtol=0.02, atol=0.0)


# -- what it costs ----------------------------------------------------------------------------------------------------


def crossing() -> eg.Scene:
    verts, faces = tangle()
    return eg.Scene([eg.Mesh(verts, faces, colors=smooth_colors(verts))], BACKGROUND)


def test_same_bits_at_any_number_of_threads():
    camera, adjoint = front_camera(48), smooth_adjoint(48, 48, 3).to(F64)
    (mesh,) = crossing().meshes
    before, grads = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            core.clear_geometry()
            torch.set_num_threads(threads)
            verts = mesh.verts.clone().requires_grad_()
            grads.append(torch.autograd.grad(eg.render(mesh.replace(verts=verts), camera, spp=4), verts, adjoint)[0])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(grads[0], grads[1]) and torch.equal(grads[0], grads[2])


def test_where_the_vertices_were_before_changes_no_bit():
    """The order in which pairs are found is kept while the vertices move."""
    camera, adjoint = front_camera(48), smooth_adjoint(48, 48, 3).to(F64)
    (mesh,) = crossing().meshes

    def gradient(scale: float = 1.0) -> Tensor:
        verts = (scale * mesh.verts).requires_grad_()
        return torch.autograd.grad(eg.render(mesh.replace(verts=verts), camera, spp=4), verts, adjoint)[0]

    core.clear_geometry()
    first = gradient()
    for scale in (1.1, 0.9):
        gradient(scale)
    assert torch.equal(gradient(), first)


def test_whether_they_are_drawn_does_not_depend_on_where_the_vertices_were():
    """Nor what is, for so many that some estimates say one thing and some the other."""
    camera, adjoint, ball = front_camera(48), smooth_adjoint(48, 48, 3).to(F64), icosphere(4)
    noise = torch.randn(ball.verts.shape, generator=generator(4), dtype=F64)

    def gradient(size: float) -> Tensor:
        verts = (ball.verts + size * noise).requires_grad_()
        return torch.autograd.grad(eg.render(ball.replace(verts=verts), camera, spp=4), verts, adjoint)[0]

    for size in torch.linspace(0.05, 0.062, 7).tolist():
        core.clear_geometry()
        first = gradient(size)
        for before in (0.3, 0.6):
            core.clear_geometry()
            gradient(before * size)
            assert torch.equal(gradient(size), first)


def test_gradient_where_they_are_drawn():
    """Of faces that the image did not hit fewer are drawn, and stand for others."""
    ball, camera = icosphere(4), front_camera(48)
    noise = torch.randn(ball.verts.shape, generator=generator(), dtype=F64)
    assert found(ball.verts + 0.08 * noise, ball.faces)[2]

    def tangled(theta: Tensor):
        return eg.Scene([ball.replace(verts=ball.verts + (0.08 + theta) * noise)], BACKGROUND), camera

    check_ratio(tangled, 0.0005, spp=512, seeds=8)


def test_plan_counts_them():
    camera = front_camera(48)
    apart = [cube(0.3).transformed(t=x * torch.tensor([1.0, 0.0, 0.0], dtype=F64)) for x in (-0.5, 0.5)]
    together = [cube(0.3), cube(0.4).transformed(t=torch.tensor([0.2, 0.3, 0.1], dtype=F64))]
    for meshes, on in ((apart, False), (together, True)):
        moving = [mesh.replace(verts=mesh.verts.clone().requires_grad_()) for mesh in meshes]
        plan = eg.plan(eg.Scene(moving), camera)
        assert plan["intersections"].on == on and (plan["intersections"].bytes > 0) == on
        assert (eg.profile(eg.Scene(moving), camera, repeats=1).samples["intersections"] > 0) == on
    assert not eg.plan(eg.Scene(together), camera)["intersections"].on
