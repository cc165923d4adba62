"""The faces that pass through each other, against exhaustion, and which of them are drawn."""

from __future__ import annotations

import pytest
import torch
from crossing_faces import F64, found, generator, joined, random_triangles, tangle
from finite_differences import check, estimate, rotation
from oracles.cut_apart import faces_that_cross
from scenes import cube, icosphere, soup
from torch import Tensor

import edgegrad as eg


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
    """Return a torus whose tube is as thick as its hole is wide, but for waves of it."""
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
    """Return the same surface with vertices of its own for each block of faces, as along the seams of a texture."""
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
    """No pairs are compared where a closed surface is a height field. With every second face turned round no surface goes on,
    so all pairs are compared, and the same faces pass through each other."""
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
