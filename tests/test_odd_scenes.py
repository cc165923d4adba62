"""Odd but valid glTF and 3MF files are loaded as the arrays that they were written from, without a word."""

import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from odd_3mf import threemf_files
from odd_gltf import gltf_files
from odd_scenes import Odd

import edgegrad as eg


def settled(count):
    return settings(
        max_examples=count, derandomize=True, database=None, deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
    )  # fmt: skip


def at_corners(values, faces):
    return None if values is None else values[faces].double().numpy()


def corner_colors(mesh):
    """(F, 3, 3) of any kind of colours."""
    if mesh.corner_colors is not None:
        return mesh.corner_colors.double().numpy()
    if mesh.face_colors is not None:
        return mesh.face_colors.double()[:, None].expand(-1, 3, -1).numpy()
    return at_corners(mesh.colors, mesh.faces)


def check(folder, odd: Odd) -> None:
    for name, content in odd.files.items():
        (folder / name).write_bytes(content)
    path = folder / next(iter(odd.files))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain, lit = eg.load_scene(path).meshes, eg.load_scene(path, lit=True).meshes
    assert len(plain) == len(lit) == len(odd.shown)
    for mesh, shaded, shown in zip(plain, lit, odd.shown, strict=True):
        normals = at_corners(shaded.normals, shaded.faces if shaded.normal_faces is None else shaded.normal_faces)
        corners = at_corners(mesh.verts, mesh.faces)
        found = corners, corner_colors(mesh), at_corners(mesh.uvs, mesh.uv_faces), normals
        assert corners.shape == shown.corners.shape
        # A triangle may begin at any of its corners.
        size = np.abs(shown.corners).max()
        turns = [np.abs(corners - np.roll(shown.corners, turn, 1)).max((1, 2)) for turn in range(3)]
        turn = int(np.argmin(np.max(turns, 1)))
        assert np.max(turns[turn]) <= 2e-6 * size + 1e-30
        for name, a, b in zip(shown._fields[1:], found[1:], shown[1:], strict=True):
            assert (a is None) == (b is None), name
            if a is not None:
                np.testing.assert_allclose(a, np.roll(b, turn, 1), atol=2e-6, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_gltf(tmp_path, count):
    @settled(count)
    @given(gltf_files())
    def test(odd):
        check(tmp_path, odd)

    test()


@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_3mf(tmp_path, count):
    @settled(count)
    @given(threemf_files())
    def test(odd):
        check(tmp_path, odd)

    test()
