"""Edges of meshes: welding, borders, half-edges."""

from __future__ import annotations

import pytest
import torch
from adjoints import random
from kernel_parts import parts
from scenes import cube, icosphere

pytestmark = [pytest.mark.quick, pytest.mark.watched]

EPS32, EPS64 = 2.0**-23, 2.0**-52


def edges_of(verts: torch.Tensor, faces: torch.Tensor, spacing: float = EPS64) -> list[list[tuple[int, int, bool]]]:
    """The edges, each a list of its half-edges (face, corner where it begins, whether against the edge)."""
    return parts.edges(verts.double().numpy(), faces.int().numpy(), [0], [spacing])


def faces_at(edges: list[list[tuple[int, int, bool]]]) -> list[int]:
    """How many faces the edges have, sorted."""
    return sorted(len(edge) for edge in edges)


def check_ends(
    verts: torch.Tensor, faces: torch.Tensor, edges: list[list[tuple[int, int, bool]]], atol: float = 0
) -> None:
    """All half-edges of an edge run between the same two places; the first one gives its direction."""
    for edge in edges:
        ends = []
        for face, corner, backwards in edge:
            pair = verts[faces[face].roll(-corner)[:2]].double()
            ends.append(pair.flip(0) if backwards else pair)
        assert not edge[0][2]
        for pair in ends:
            torch.testing.assert_close(pair, ends[0], rtol=0, atol=atol)


def split(verts: torch.Tensor, faces: torch.Tensor, groups: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices copied, so that faces of different groups (F,) share none."""
    pairs, index = torch.unique(
        torch.stack([groups[:, None].expand(-1, 3), faces], -1).reshape(-1, 2), dim=0, return_inverse=True
    )
    return verts[pairs[:, 1]], index.reshape(-1, 3)


def rotation32() -> torch.Tensor:
    """An oblique rotation in float32."""
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -0.6, 0.3], [0.6, 0.0, -0.8], [-0.3, 0.8, 0.0]]))


CUBE = cube()
ONE_QUAD = torch.arange(12) // 2  # faces 2 i and 2 i + 1 make a side of the cube


@pytest.mark.parametrize(
    "groups, verts",
    [(torch.zeros(12, dtype=torch.int64), 8), (ONE_QUAD, 24), (torch.arange(12), 36)],
    ids=["welded", "split at its edges", "soup"],
)
def test_cube_has_18_edges(groups, verts):
    """12 edges and 6 diagonals, each with two faces, however often the vertices are repeated."""
    v, f = split(CUBE.verts, CUBE.faces, groups)
    assert len(v) == verts
    edges = edges_of(v, f)
    assert faces_at(edges) == [2] * 18
    check_ends(v, f, edges)
    # The surface is oriented, so the two faces of an edge run along it in opposite directions.
    assert all(edge[0][2] != edge[1][2] for edge in edges)


def test_edges_come_in_the_order_of_the_faces():
    """However the vertices are numbered: neighbouring edges are neighbours in memory where faces are."""
    faces = torch.tensor([[7, 2, 5], [5, 2, 0], [0, 2, 6]])
    edges = edges_of(torch.eye(8)[:, :3] + torch.arange(8)[:, None], faces)
    sides = [{int(faces[f, c]), int(faces[f, (c + 1) % 3])} for ((f, c, _), *_) in edges]
    # By the vertex that comes first, and those of one vertex by the other: 7, 2, 5, 0, 6.
    assert sides == [{7, 2}, {7, 5}, {2, 5}, {2, 0}, {2, 6}, {5, 0}, {0, 6}]


def test_half_edges_cover_every_side_once():
    mesh = icosphere(2)
    edges = edges_of(mesh.verts, mesh.faces)
    assert faces_at(edges) == [2] * (3 * len(mesh.faces) // 2)
    sides = sorted((face, corner) for edge in edges for face, corner, _ in edge)
    assert sides == [(f, c) for f in range(len(mesh.faces)) for c in range(3)]


def test_border_and_three_faces_on_one_edge():
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, -1]])
    faces = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    edges = edges_of(verts, faces)
    assert faces_at(edges) == [1] * 6 + [3]
    shared = next(edge for edge in edges if len(edge) == 3)
    assert sorted(face for face, _, _ in shared) == [0, 1, 2]
    assert {face: backwards for face, _, backwards in shared} == {0: False, 1: True, 2: False}
    soup, index = split(verts, faces, torch.arange(3))
    assert faces_at(edges_of(soup, index)) == [1] * 6 + [3]


def test_faces_that_repeat_a_vertex_are_ignored():
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 0]])
    good = torch.tensor([[0, 1, 2], [1, 3, 2]])
    bad = torch.tensor([[0, 0, 1], [2, 2, 2], [3, 1, 3]])
    assert faces_at(edges_of(verts, torch.cat([good, bad]))) == faces_at(edges_of(verts, good)) == [1] * 4 + [2]
    assert edges_of(verts, bad) == []
    # A face may also repeat a place by way of a copy of its vertex: 4 lies on 0.
    assert faces_at(edges_of(verts, torch.cat([good, torch.tensor([[0, 4, 1]])]))) == [1] * 4 + [2]


@pytest.mark.parametrize("scale, shift", [(1e-4, 0.0), (1e4, 50.0)])
def test_rotated_soup_welds(scale, shift):
    """A user's own matrix product may round the copies of a vertex differently, by some float32 spacings."""
    mesh = icosphere(3)
    soup, index = split(scale * mesh.verts.float(), mesh.faces, torch.arange(len(mesh.faces)))
    moved = soup @ rotation32().mT + scale * shift
    edges = edges_of(moved, index, EPS32)
    assert faces_at(edges) == [2] * (3 * len(mesh.faces) // 2)
    check_ends(moved, index, edges, atol=8 * EPS32 * float(moved.abs().max()))


def test_copies_off_by_roundings_weld_at_their_own_precision_only():
    """The positions are equal, once as float32 numbers and once as float64 numbers that mean to be apart."""
    soup, index = split(CUBE.verts, CUBE.faces, torch.arange(12))
    noise = torch.from_numpy(random(len(soup), 3, seed=10)).clamp(-1, 1)
    moved = soup + 0.6 * EPS32 * noise
    assert faces_at(edges_of(moved, index, EPS32)) == [2] * 18
    assert faces_at(edges_of(moved, index, EPS64)) == [1] * 36


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 100 * EPS32])
def test_near_vertices_do_not_weld(gap):
    """Two triangles side by side with a slit between them, 100 spacings wide or more."""
    a = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    b = torch.tensor([[1.0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)
    faces = torch.arange(6).reshape(2, 3)
    assert faces_at(edges_of(torch.cat([a, b]), faces, EPS32)) == [1] * 4 + [2]
    assert faces_at(edges_of(torch.cat([a, b + gap]), faces, EPS32)) == [1] * 6


def test_vertices_inside_a_closed_surface_do_not_weld():
    """Two cubes that share a side by position are closed each by itself: no edge gets four faces."""
    verts = torch.cat([CUBE.verts, CUBE.verts + torch.tensor([1.2, 0.0, 0.0])])
    faces = torch.cat([CUBE.faces, CUBE.faces + 8])
    assert faces_at(edges_of(verts, faces)) == [2] * 36
