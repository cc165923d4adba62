"""Odd but valid files, compared corner by corner with the arrays that they were written from."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from odd_files import FILES, Expected, File

import edgegrad as eg


def check(folder: Path, file: File) -> None:
    for name, content in file.contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what nobody reads
        scene = eg.load_scene(folder / next(iter(file.contents)), lit=True)
    extent = np.ptp(np.concatenate([part.corners.reshape(-1, 3) for part in file.parts]), axis=0).max()
    assert len(scene.meshes) == len(file.parts)
    for mesh, expected in zip(scene.meshes, file.parts, strict=True):
        compare(mesh, expected, extent)


def compare(mesh: eg.Mesh, expected: Expected, extent: float) -> None:
    assert mesh.name == expected.name
    rows = expected.corners.reshape(-1, 3).astype(str(mesh.verts.dtype).removeprefix("torch."))
    assert len(mesh.verts) == len(np.unique(rows, axis=0))  # welded
    np.testing.assert_allclose(mesh.verts[mesh.faces], expected.corners, rtol=0, atol=1e-6 * extent)
    assert (mesh.uvs is None) == (expected.uvs is None)
    if mesh.uvs is not None:
        np.testing.assert_array_equal(mesh.uvs[mesh.uv_faces], expected.uvs)
    assert (mesh.normals is None) == (expected.normals is None)
    if mesh.normals is not None:
        index = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
        unit = expected.normals / np.linalg.norm(expected.normals, axis=-1, keepdims=True)
        np.testing.assert_allclose(mesh.normals[index], unit, atol=1e-6)
    colors = mesh.corner_colors
    if mesh.colors is not None:
        colors = mesh.colors[mesh.faces]
    elif mesh.face_colors is not None:
        colors = mesh.face_colors[:, None].expand(-1, 3, -1)
    assert (colors is None) == (expected.colors is None)
    if colors is not None:
        np.testing.assert_allclose(colors, expected.colors, atol=1e-6)


QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]


@pytest.mark.parametrize("kind", FILES)
def test_odd_files(tmp_path: Path, kind: str) -> None:
    run(tmp_path, kind, 40)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FILES)
def test_more_odd_files(tmp_path: Path, kind: str) -> None:
    run(tmp_path, kind, 1250)


def run(folder: Path, kind: str, examples: int) -> None:
    @settings(max_examples=examples, deadline=None, database=None, derandomize=True, suppress_health_check=QUIET)
    @given(file=FILES[kind])
    def each(file: File) -> None:
        check(folder, file)

    each()
