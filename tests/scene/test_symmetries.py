"""Symmetries of meshes: those of solids whose groups are known, and poses up to them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from quiet_fits import quiet

import edgegrad as eg
from edgegrad.fit.pose.result import PoseFit
from edgegrad.scene.symmetry_axis import about

DISPLACED = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.9]))
DISPLACED[:3, 3] = 3.0, -2.0, 5.0


def mesh_of(solid: trimesh.Trimesh, displaced: bool = True, **fields: torch.Tensor) -> eg.Mesh:
    """Return a mesh with axes and centre where nobody would expect them."""
    solid = solid.copy()
    if displaced:
        solid.apply_transform(DISPLACED)
    return eg.Mesh(torch.tensor(np.array(solid.vertices)), torch.tensor(np.array(solid.faces)), **fields)


def prism(sides: int, height: float = 0.9) -> trimesh.Trimesh:
    angle = np.arange(sides) * 2 * np.pi / sides
    flat = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], 1), np.zeros((1, 2))])
    faces = np.array([[i, (i + 1) % sides, sides] for i in range(sides)])
    return trimesh.creation.extrude_triangulation(flat, faces, height)


def blob(mirror: bool = False) -> trimesh.Trimesh:
    """Return a mesh without a symmetry, or the same on both sides, as most animals."""
    ball = trimesh.creation.icosphere(3)
    x, y, z = ball.vertices.T
    x = np.abs(x) if mirror else x
    radius = 1 + 0.25 * np.sin(2 * x + 1) + 0.15 * np.cos(3 * y + 0.5) + 0.2 * z**3 + 0.1 * np.sin(5 * x * y)
    return trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces)


TETRAHEDRON = trimesh.Trimesh(
    [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solid, order",
    [
        (trimesh.creation.box((1, 1, 1)), 24), (trimesh.creation.box((1, 2, 3)), 4), (trimesh.creation.box((1, 1, 2)), 8),
        (trimesh.creation.icosahedron(), 60), (TETRAHEDRON, 12), (prism(3), 6), (prism(5), 10), (prism(9), 18),
        (prism(6, 1.7), 12), (blob(), 1), (blob(mirror=True), 1),
    ],
    ids=["cube", "box", "square box", "icosahedron", "tetrahedron", "3", "5", "9", "6 of equal moments", "blob", "mirrored"],
)  # fmt: skip
def test_of_solids(solid: trimesh.Trimesh, order: int) -> None:
    mesh = mesh_of(solid)
    found = eg.Symmetries.find(mesh)
    motions = found.motions
    assert len(motions) == order and not found.continuous and found.trivial == (order == 1)
    assert torch.equal(motions[0], torch.eye(4, dtype=torch.float64))
    R, t = motions[:, :3, :3], motions[:, None, :3, 3]
    moved = mesh.verts @ R.mT + t
    if order > 1:  # vertices land on vertices, all of them
        distance = (moved[:, :, None] - mesh.verts).norm(dim=-1)
        assert float(distance.amin(1).max()) < 1e-6 and float(distance.amin(2).max()) < 1e-6
    # A group: each once, and all products.
    products = (motions[:, None] @ motions).reshape(-1, 1, 4, 4)
    near = (products - motions).abs().amax((2, 3)) < 1e-6
    assert bool((near.sum(1) == 1).all())


@pytest.mark.parametrize(
    "solid, discrete",
    [
        (trimesh.creation.cylinder(1, 2.5, sections=64), 2), (trimesh.creation.cone(1, 2, sections=64), 1),
        (trimesh.creation.torus(2, 0.5, 64, 32), 2), (prism(40), 2),
        (trimesh.creation.cylinder(1, 1.38, sections=64), 2),  # whose variances are all about equal
    ],
    ids=["cylinder", "cone", "torus", "prism of 40", "cylinder of equal moments"],
)  # fmt: skip
def test_continuous(solid: trimesh.Trimesh, discrete: int) -> None:
    found = eg.Symmetries.find(mesh_of(solid))
    assert len(found.continuous) == 1 and len(found.motions) == discrete and not found.spherical
    axis = found.continuous[0]
    z = torch.tensor(DISPLACED[:3, 2])
    assert float(torch.linalg.cross(axis.direction, z).norm()) < 1e-3
    center = torch.tensor((DISPLACED @ [*solid.bounds.mean(0)[:2], 0, 1])[:3])
    assert float(torch.linalg.cross(axis.offset - center, z).norm()) < 1e-3
    if discrete == 2:  # a half turn across the axis
        flip = found.motions[1, :3, :3]
        assert float((flip @ z + z).norm()) < 1e-3 and abs(float(flip.trace()) + 1) < 1e-9


def test_sphere() -> None:
    found = eg.Symmetries.find(mesh_of(trimesh.creation.icosphere(4)))
    assert found.spherical and len(found.continuous) == 3
    pose, reference = rigid((0.3, 1.0, -0.2), (1.0, 2.0, 3.0)), rigid((2.0, 0.1, 0.4), (0.0, -1.0, 2.0))
    closest = found.closest(pose, reference)
    center = torch.tensor([*DISPLACED[:3, 3], 1.0])
    assert torch.allclose(closest[:3, :3], reference[:3, :3], atol=1e-12)
    assert torch.allclose(closest @ center, pose @ center, atol=1e-3)
    assert found.error(pose, reference).degrees < 1e-6


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_units_of_length(scale: float) -> None:
    found = eg.Symmetries.find(mesh_of(trimesh.creation.box((scale, 2 * scale, 3 * scale)), displaced=False))
    assert len(found.motions) == 4


def test_tolerance() -> None:
    """The corners of a prism of 8 sides stand out by 1 - cos(π/8) of the radius, 0.028 of the size."""
    wide = eg.Symmetries.find(mesh_of(prism(8)), 0.04)
    assert len(wide.continuous) == 1 and len(eg.Symmetries.find(mesh_of(prism(8)), 0.02).motions) == 16


def test_a_propeller() -> None:
    """It has order 5, without flips. Orders above max_order are not found, but those that divide it."""
    blades = [
        trimesh.creation.box((1.0, 0.2, 0.1), trimesh.transformations.translation_matrix((0.7, 0.15, 0.3)))
        .apply_transform(trimesh.transformations.rotation_matrix(2 * np.pi * k / 5, (0, 0, 1)))
        for k in range(5)
    ]  # fmt: skip
    solid = trimesh.util.concatenate([*blades, trimesh.creation.cylinder(0.3, 0.5, sections=60)])
    solid.vertices[:, 2] += 0.3 * np.hypot(solid.vertices[:, 0], solid.vertices[:, 1])
    found = eg.Symmetries.find(mesh_of(solid))
    assert len(found.motions) == 5 and not found.continuous
    assert eg.Symmetries.find(mesh_of(solid), max_order=4).trivial


def test_noise_below_the_tolerance() -> None:
    solid = prism(6, 3.0).subdivide().subdivide()
    solid.vertices += np.random.default_rng(0).normal(0, 0.004, solid.vertices.shape)
    found = eg.Symmetries.find(mesh_of(solid), 0.02)
    assert len(found.motions) == 12
    angles = [eg.Symmetries().error(m, torch.eye(4)).degrees for m in found.motions]
    assert np.allclose(sorted(angles)[:3], [0, 60, 60], atol=0.5)


def test_colors_break_them() -> None:
    """A box with a square base has 8 rotations."""
    solid = trimesh.creation.box((1, 1, 2))
    one, other = torch.tensor([0.8, 0.2, 0.2]), torch.tensor([0.2, 0.2, 0.8])

    def painted(where: np.ndarray) -> eg.Mesh:
        return mesh_of(solid, face_colors=torch.where(torch.tensor(where)[:, None], other, one))

    x, _, z = solid.face_normals.T
    top = painted(z > 0.5)
    assert len(eg.Symmetries.find(top).motions) == 4
    assert len(eg.Symmetries.find(painted(x > 0.5)).motions) == 2
    assert len(eg.Symmetries.find(top, textured=False).motions) == 8
    assert len(eg.Symmetries.find(top, color_tolerance=1.0).motions) == 8


@pytest.mark.slow
def test_a_texture_breaks_them() -> None:
    """A cube whose sides all show one picture: a letter; or the same picture turned by any quarter."""
    faces = trimesh.creation.box((1, 1, 1))
    corners = faces.vertices[faces.faces]  # (12, 3, 3)
    uvs = []
    for normal, corner in zip(faces.face_normals, corners, strict=True):
        axes = [i for i in range(3) if abs(normal[i]) < 0.5]
        uvs.append(corner[:, axes] + 0.5)
    flat = torch.tensor(np.concatenate(uvs))
    image = torch.full((32, 32, 3), 0.7)
    mesh = mesh_of(faces, texture=image, uvs=flat, uv_faces=torch.arange(36).reshape(12, 3))
    assert len(eg.Symmetries.find(mesh).motions) == 24
    letter = image.clone()
    letter[6:26, 8:12] = letter[22:26, 8:22] = 0.05
    assert eg.Symmetries.find(mesh.replace(texture=letter, uvs=mesh.uvs, uv_faces=mesh.uv_faces)).trivial
    ring = image.clone()
    ring[12:20, 12:20] = 0.05
    assert len(eg.Symmetries.find(mesh.replace(texture=ring, uvs=mesh.uvs, uv_faces=mesh.uv_faces)).motions) == 24


def test_of_a_scene_and_again() -> None:
    """Two halves of a box; the same numbers each time."""
    left, right = (mesh_of(trimesh.creation.box(bounds=[[a, 0, 0], [a + 1, 1.2, 3.0]])) for a in (0.0, 1.0))
    first, again = (eg.Symmetries.find(eg.Scene([left, right])) for _ in range(2))
    assert len(first.motions) == 4 and torch.equal(first.motions, again.motions)


# -- poses up to them -----------------------------------------------------------------------------------------------------


def rigid(turn: tuple[float, ...], shift: tuple[float, ...]) -> torch.Tensor:
    axis = torch.tensor(turn, dtype=torch.float64)
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = about(axis / axis.norm(), axis.norm()[None])[0]
    M[:3, 3] = torch.tensor(shift)
    return M


def test_closest_of_discrete() -> None:
    found = eg.Symmetries.find(mesh_of(trimesh.creation.box((1, 1, 1))))
    reference = rigid((0.3, 1.0, -0.2), (1.0, 2.0, 3.0))
    off = reference @ rigid((0.05, 0.0, 0.0), (0.0, 0.1, 0.0))
    for motion in found.motions:
        assert torch.allclose(found.closest(off @ motion, reference), off, atol=1e-6)
    error = found.error(off @ found.motions[5], reference)
    assert abs(error.degrees - math.degrees(0.05)) < 1e-5 and abs(error.distance - 0.1) < 1e-5
    assert eg.Symmetries().error(off @ found.motions[5], reference).degrees > 45.0


def test_closest_is_exact_about_an_axis() -> None:
    axis = eg.Symmetries.Axis([0.0, 0.6, 0.8], [1.0, 0.0, 2.0])
    flip = 2.0 * np.outer([1.0, 0, 0], [1.0, 0, 0]) - np.eye(3)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = flip, np.array([1.0, 0.0, 2.0]) - flip @ [1.0, 0.0, 2.0]
    found = eg.Symmetries(motion[None], [axis])
    pose, reference = rigid((0.3, 1.0, -0.2), (1.0, 2.0, 3.0)), rigid((2.0, 0.1, 0.4), (0.0, -1.0, 2.0))
    closest = found.closest(pose, reference)
    plain = eg.Symmetries()
    all_of_them = pose @ found.transforms(0.005)
    fine = min(plain.error(one, reference).degrees for one in all_of_them)
    exact = plain.error(closest, reference).degrees
    assert exact <= fine + 1e-9 and fine - exact < 0.1
    # It is one of them, and with a scale as well.
    assert float((all_of_them - closest).abs().amax((1, 2)).min()) < 0.05
    scale = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=torch.float64))
    assert torch.allclose(found.closest(pose @ scale, reference)[:3, :3], 2.0 * closest[:3, :3], atol=1e-12)


def test_fit_pose_reports_the_nearest() -> None:
    """The search is the same; its result is turned by what the symmetries leave free."""
    cylinder = mesh_of(trimesh.creation.cylinder(1, 3, sections=32), displaced=False)
    camera = eg.Camera.look_at((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (32, 32))
    truth = rigid((1.0, 0.4, 0.0), (0.1, 0.2, 0.0))
    shown = eg.render_aovs(cylinder.transformed(truth[:3, :3], truth[:3, 3]), camera, ["image", "alpha"], seed=0)
    start = truth @ rigid((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)) @ rigid((0.1, 0.05, 0.0), (0.05, 0.0, 0.0))

    def fitted(symmetries: eg.Symmetries | None, mesh: eg.Mesh = cylinder) -> PoseFit:
        return eg.fit.fit_pose(
            mesh, shown["image"], camera, shown["alpha"][..., 0], start, search=False, symmetries=symmetries,
            options=quiet(steps=2),
        )  # fmt: skip

    free, found = fitted(None), eg.Symmetries.find(cylinder)
    nearest = found.closest(free, start)
    assert float((nearest - free.matrix).abs().max()) > 1e-5
    fit = fitted(found)
    assert torch.allclose(fit.matrix, nearest, atol=1e-12) and fit.loss == free.loss
    assert torch.allclose(fitted("find").matrix, nearest, atol=1e-12)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"symmetries: expected Symmetries, .find. or None, got 'all'"):
        fitted("all")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"symmetries: expected Symmetries, .* got Tensor"):
        fitted(torch.eye(4))  # pyright: ignore[reportArgumentType]


def test_transforms_are_those_of_bop() -> None:
    """⌈π / 0.01⌉ = 315 turns about the axis, after each discrete one."""
    info = {
        "symmetries_discrete": [[-1.0, 0, 0, 2, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]],
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [1.0, 0, 0]}],
    }
    found = eg.Symmetries.from_bop(info)
    T = found.transforms()
    assert T.shape == (630, 4, 4)
    angle = 2 * math.pi / 315 * 7
    R = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    point = torch.tensor([0.3, -0.4, 0.5], dtype=torch.float64)
    offset = torch.tensor([1.0, 0.0, 0.0])
    assert torch.allclose(T[7, :3, :3] @ point + T[7, :3, 3], R.double() @ (point - offset) + offset, atol=1e-6)
    assert torch.allclose(T[315 + 7], T[7] @ found.motions[1])
    again = eg.Symmetries.from_bop(found.to_bop())
    assert (
        torch.equal(again.motions, found.motions)
        and found.to_bop()["symmetries_continuous"] == info["symmetries_continuous"]
    )
    assert eg.Symmetries().to_bop() == {} and eg.Symmetries.from_bop({"diameter": 3.0}).trivial
    small = found.scaled(0.001)
    assert float(small.motions[1, 0, 3]) == 0.002 and float(small.continuous[0].offset[0]) == 0.001


@pytest.mark.parametrize(
    "make, error, words",
    [
        (lambda: eg.Symmetries(torch.eye(3)[None]), ValueError, r"discrete: expected shape \(N, 4, 4\)"),
        (lambda: eg.Symmetries(torch.diag(torch.tensor([1.0, 1, -1, 1]))[None]), ValueError, r"discrete\[0\]: .*mirror"),
        (lambda: eg.Symmetries(torch.ones(1, 4, 4)), ValueError, r"discrete\[0\]: expected the last row"),
        (lambda: eg.Symmetries(continuous=[torch.eye(3)]), TypeError, r"continuous\[0\]: expected a Symmetries.Axis"),
        (lambda: eg.Symmetries.Axis([0.0, 0, 0]), ValueError, "direction: expected a length above zero"),
        (lambda: eg.Symmetries.from_bop({"symmetries_discrete": [[1, 2]]}), ValueError, "symmetries_discrete: .*16"),
        (lambda: eg.Symmetries.from_bop({"symmetries_continuous": [{"axis": [0, 0, 1]}]}), ValueError, "axis and offset"),
        (lambda: eg.Symmetries().closest(torch.eye(3), torch.eye(4)), ValueError, r"pose: expected shape \(4, 4\)"),
        (lambda: eg.Symmetries().error(torch.eye(4), -torch.eye(4)), ValueError, "reference: expected the last row"),
        (lambda: eg.Symmetries().transforms(0.0), ValueError, "step: expected"),
        (lambda: eg.Symmetries.find(mesh_of(prism(3)), 0.0), ValueError, "tolerance: expected"),
        (lambda: eg.Symmetries.find(mesh_of(prism(3)), max_order=1), ValueError, "max_order: expected"),
        (lambda: eg.Symmetries.find(mesh_of(prism(3)), textured=1), TypeError, "textured: expected True or False"),
        (lambda: eg.Symmetries.find(torch.eye(3)), TypeError, "expected a"),
        (lambda: eg.Symmetries.find(eg.Mesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))), ValueError, "area"),
    ],
)  # fmt: skip
def test_messages(make, error, words) -> None:
    with pytest.raises(error, match=words):
        make()
