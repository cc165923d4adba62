"""Meshes of simple shapes: what they enclose, which side is their front, their textures, and their derivatives."""

from __future__ import annotations

import doctest
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.quick

F64 = torch.float64
CENTER, U, V = (1.0, 2.0, 3.0), (0.0, 0.5, 0.0), (0.0, 0.0, 2.0)
ROUND = {
    "box": (lambda: eg.shapes.box(CENTER, (1.0, 2.0, 3.0), dtype=F64), 6.0),
    "sphere": (lambda: eg.shapes.sphere(CENTER, 2.0, 5, dtype=F64), 32 / 3 * math.pi),
}
FLAT = {
    "rectangle": (lambda: eg.shapes.rectangle(CENTER, U, V, dtype=F64), 4.0),
    "disc": (lambda: eg.shapes.disc(CENTER, U, V, 500, dtype=F64), math.pi),
    "grid": (lambda: eg.shapes.grid(3, 5, CENTER, U, V, dtype=F64), 4.0),
}
Make = Callable[[], eg.Mesh]


def corners(mesh: eg.Mesh) -> Tensor:
    return mesh.verts[mesh.faces]


def areas(mesh: eg.Mesh) -> Tensor:
    a, b, c = corners(mesh).unbind(1)
    return torch.linalg.cross(b - a, c - a) / 2


@pytest.mark.parametrize("make, volume", ROUND.values(), ids=ROUND)
def test_closed_shapes_enclose_their_volume(make: Make, volume: float) -> None:
    mesh = make()
    a, b, c = corners(mesh).unbind(1)
    assert float((a * torch.linalg.cross(b, c)).sum() / 6) == pytest.approx(volume, rel=3e-3)
    outward = (areas(mesh) * (corners(mesh).mean(1) - torch.tensor(CENTER, dtype=F64))).sum(1)
    assert bool((outward > 0).all())
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(edges.unique(dim=0)) == len(edges)  # each is met once in each direction
    assert len(edges.sort(1).values.unique(dim=0)) == len(edges) // 2


@pytest.mark.parametrize("make, area", FLAT.values(), ids=FLAT)
def test_flat_shapes_face_along_u_cross_v(make: Make, area: float) -> None:
    mesh = make()
    total = areas(mesh).sum(0)
    assert total.tolist() == pytest.approx([area, 0.0, 0.0], rel=1e-4)
    assert bool((areas(mesh)[:, 0] > 0).all())
    assert mesh.uvs is not None
    at = 2 * mesh.uvs - 1  # along u and v
    u, v, center = (torch.tensor(x, dtype=F64) for x in (U, V, CENTER))
    torch.testing.assert_close(mesh.verts, center + at[:, :1] * u + at[:, 1:] * v)


@pytest.mark.parametrize("make", [make for make, _ in (*ROUND.values(), *FLAT.values())], ids=[*ROUND, *FLAT])
def test_textures_are_not_mirrored(make: Make) -> None:
    """Seen from the front, corners run counter-clockwise on the texture, too."""
    mesh = make()
    assert mesh.uvs is not None and mesh.uv_faces is not None
    a, b, c = mesh.uvs[mesh.uv_faces].unbind(1)
    (x, y), (s, t) = (b - a).unbind(1), (c - a).unbind(1)
    assert bool((x * t - y * s > 0).all())
    assert float((x.abs() + s.abs()).amax()) <= 2.0  # no face runs around the globe


def test_a_map_on_a_sphere() -> None:
    mesh = eg.shapes.sphere(subdivisions=4, dtype=F64)
    assert mesh.uvs is not None and mesh.uv_faces is not None
    directions = torch.nn.functional.normalize(corners(mesh).mean(1), dim=1)
    u, v = mesh.uvs[mesh.uv_faces].mean(1).unbind(1)
    longitude, latitude = 2 * math.pi * (u - 0.5), math.pi * (v - 0.5)
    globe = torch.stack([latitude.cos() * longitude.sin(), latitude.sin(), latitude.cos() * longitude.cos()], 1)
    assert float((globe - directions).norm(dim=1).max()) < 0.02


def test_dtype_is_that_of_the_tensors() -> None:
    center = torch.zeros(3, dtype=F64)
    assert eg.shapes.sphere(subdivisions=0).verts.dtype == torch.float32
    assert eg.shapes.sphere(center, subdivisions=0).verts.dtype == F64
    assert eg.shapes.box(center, dtype=torch.float32).verts.dtype == torch.float32
    assert eg.shapes.rectangle(u=torch.ones(3, dtype=F64)).verts.dtype == F64


def test_positions_have_derivatives() -> None:
    center = torch.tensor(CENTER, dtype=F64, requires_grad=True)
    size = torch.tensor([1.0, 2.0, 3.0], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c, s: eg.shapes.box(c, s).verts, (center, size))
    radius = torch.tensor(0.7, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c, r: eg.shapes.sphere(c, r, 1).verts, (center, radius))
    assert torch.autograd.gradcheck(lambda c, u: eg.shapes.disc(c, u, V, 5).verts, (center, size))


def test_a_light_that_is_a_mesh_too_counts_once() -> None:
    lamp = eg.shapes.rectangle(material=eg.Material(emission=1.0))
    assert len(eg.Scene([lamp], lights=[lamp]).meshes) == 1
    assert len(eg.Scene([lamp], lights=[lamp.replace()]).meshes) == 2


def test_with_emission_they_are_lights() -> None:
    lamp = eg.shapes.disc(material=eg.Material(base_color=0.0, emission=3.0), dtype=F64)
    camera = eg.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov_y=20.0, size=(4, 4))
    assert torch.allclose(eg.render(lamp, camera, 1, seed=0), torch.tensor(3.0, dtype=F64))


@pytest.mark.parametrize(
    "make, error, message",
    [
        (lambda: eg.shapes.rectangle((0, 0)), ValueError, r"center: expected shape \(3,\)"),
        (lambda: eg.shapes.rectangle("here"), TypeError, "center: expected"),
        (lambda: eg.shapes.rectangle(u=(0, math.nan, 0)), ValueError, "u: expected finite"),
        (lambda: eg.shapes.rectangle(dtype=torch.float16), TypeError, "dtype: expected torch.float32"),
        (lambda: eg.shapes.rectangle(material=3), TypeError, "material: expected a Material"),
        (lambda: eg.shapes.disc(segments=2), ValueError, "segments: expected an int from 3"),
        (lambda: eg.shapes.grid(0, 3), ValueError, "rows: expected an int from 1"),
        (lambda: eg.shapes.grid(3, 2.5), TypeError, "columns: expected"),
        (lambda: eg.shapes.box(size=0.0), ValueError, "size: expected numbers above 0"),
        (lambda: eg.shapes.box(size=(1, 2)), ValueError, r"size: expected shape \(3,\)"),
        (lambda: eg.shapes.sphere(radius=-1.0), ValueError, "radius: expected numbers above 0"),
        (lambda: eg.shapes.sphere(radius=(1.0, 2.0)), ValueError, "radius: expected one number"),
        (lambda: eg.shapes.sphere(subdivisions=10), ValueError, "subdivisions: expected an int from 0 to 9"),
    ],
)
def test_errors_name_the_argument(make: Make, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


def test_examples_run() -> None:
    found = doctest.testmod(eg.shapes)
    assert found.attempted > 8 and not found.failed
