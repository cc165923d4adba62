"""Unusual but valid files, compared corner by corner with the arrays that they were written from."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from drawn_3mf import threemf_files
from drawn_files import DrawnFile, ExpectedMesh
from drawn_gltf import gltf_files
from drawn_text_formats import TEXT_FORMATS
from hypothesis import HealthCheck, given, settings

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

FORMATS = {**TEXT_FORMATS, "gltf": gltf_files(), "3mf": threemf_files()}
QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]


def at_corners(values, index):
    return None if values is None else values[index].double().numpy()


def corner_colors(mesh):
    """Return colours (F, 3, 3) of any kind."""
    if mesh.corner_colors is not None:
        return mesh.corner_colors.double().numpy()
    if mesh.face_colors is not None:
        return mesh.face_colors.double()[:, None].expand(-1, 3, -1).numpy()
    return at_corners(mesh.colors, mesh.faces)


def compare(mesh: eg.Mesh, lit: eg.Mesh, expected: ExpectedMesh, extent: float) -> None:
    """Compare the mesh, and the normals of the same mesh for lit scenes. A triangle may begin at any of its corners."""
    corners = at_corners(mesh.verts, mesh.faces)
    assert corners.shape == expected.corners.shape
    turns = [np.abs(corners - np.roll(expected.corners, turn, 1)).max() for turn in range(3)]
    turn = int(np.argmin(turns))
    assert turns[turn] <= 2e-6 * extent + 1e-30
    normals = at_corners(lit.normals, lit.faces if lit.normal_faces is None else lit.normal_faces)
    unit = expected.normals
    if unit is not None:
        unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    uvs = at_corners(mesh.uvs, mesh.uv_faces)
    for name, a, b in (
        ("colors", corner_colors(mesh), expected.colors), ("uvs", uvs, expected.uvs), ("normals", normals, unit),
    ):  # fmt: skip
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_allclose(a, np.roll(b, turn, 1), atol=2e-6, rtol=1e-6, err_msg=name)


def check_text(folder: Path, file: DrawnFile) -> None:
    """Check that names are kept, vertices are welded, faces begin at their first corner, and texture coordinates are
    exact."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what nobody reads
        found = eg.load_scene(folder / next(iter(file.contents)), lit=True).meshes
    extent = np.ptp(np.concatenate([mesh.corners.reshape(-1, 3) for mesh in file.meshes]), axis=0).max()
    assert [mesh.name for mesh in found] == [mesh.name for mesh in file.meshes]
    for mesh, expected in zip(found, file.meshes, strict=True):
        compare(mesh, mesh, expected, extent)
        rows = expected.corners.reshape(-1, 3).astype(str(mesh.verts.dtype).removeprefix("torch."))
        assert len(mesh.verts) == len(np.unique(rows, axis=0))
        np.testing.assert_allclose(mesh.verts[mesh.faces], expected.corners, rtol=0, atol=1e-6 * extent)
        if mesh.uvs is not None:
            np.testing.assert_array_equal(mesh.uvs[mesh.uv_faces], expected.uvs)


def check_scene(folder: Path, file: DrawnFile) -> None:
    """Check that meshes are in their places, and that nothing is warned of."""
    path = folder / next(iter(file.contents))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain, lit = eg.load_scene(path).meshes, eg.load_scene(path, lit=True).meshes
    assert len(plain) == len(lit) == len(file.meshes)
    for mesh, shaded, expected in zip(plain, lit, file.meshes, strict=True):
        compare(mesh, shaded, expected, np.abs(expected.corners).max())


@pytest.mark.parametrize("count", [1, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("kind", "examples"), [*((kind, 15) for kind in TEXT_FORMATS), ("gltf", 25), ("3mf", 15)])
def test_unusual_files(tmp_path: Path, kind: str, examples: int, count: int) -> None:
    @settings(
        max_examples=count * examples, deadline=None, database=None, derandomize=True, suppress_health_check=QUIET
    )
    @given(file=FORMATS[kind])
    def each(file: DrawnFile) -> None:
        for name, content in file.contents.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_bytes(content)
        (check_text if kind in TEXT_FORMATS else check_scene)(tmp_path, file)

    each()
