"""Faces with any number of corners cover their area, in every format that has them."""

import math
import sys
import tracemalloc

import mapbox_earcut
import numpy as np
import pytest
import torch
from mesh_files import SQUARE, ply

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

C = [[1, -1], [1, -0.6], [-0.6, -0.6], [-0.6, 0.6], [1, 0.6], [1, 1], [-1, 1], [-1, -1]]
ARROW = [[0, 0], [2, 1], [0, 2], [0.5, 1]]  # a concave quad, whose reflex corner is the last
SPIRAL = [[0, 0], [5, 0], [5, 5], [0, 5], [0, 2], [3, 2], [3, 3], [1, 3], [1, 4], [4, 4], [4, 1], [0, 1]]


def area(polygon):
    """Return the area by the shoelace formula."""
    x, y = np.array(polygon, np.float64).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def covered(mesh):
    """Return the areas of all triangles as vectors, whose sign is that of the side seen along −z."""
    a, b, c = mesh.verts[mesh.faces].double().unbind(1)
    return 0.5 * torch.linalg.cross(b - a, c - a)


def written(folder, kind, polygons):
    """Write a file of flat polygons, each with vertices of its own."""
    verts = [[*p, 0.0] for polygon in polygons for p in polygon]
    starts = np.cumsum([0] + [len(p) for p in polygons])
    faces = [list(range(start, start + len(p))) for start, p in zip(starts, polygons, strict=False)]
    path = folder / f"a.{kind}"
    if kind == "ply":
        path.write_bytes(ply(verts, faces, binary=True))
    elif kind == "obj":
        lines = ["v {} {} {}".format(*v) for v in verts] + ["f " + " ".join(str(i + 1) for i in f) for f in faces]
        path.write_text("\n".join(lines))
    else:
        lines = ["OFF", f"{len(verts)} {len(faces)} 0"] + ["{} {} {}".format(*v) for v in verts]
        path.write_text("\n".join(lines + [" ".join(map(str, [len(f), *f])) for f in faces]))
    return path


@pytest.mark.parametrize("kind", ["obj", "ply", "off"])
def test_concave_faces_cover_their_area(tmp_path, kind):
    """Faces begin at every corner, have both orientations, and stand among triangles and convex faces, which stay
    fans."""
    turned = [np.roll(shape, n, axis=0).tolist() for shape in (C, ARROW, SPIRAL) for n in range(len(shape))]
    turned += [polygon[::-1] for polygon in turned]
    for polygon in turned:
        mesh = eg.load_mesh(written(tmp_path, kind, [[corner[:2] for corner in SQUARE], polygon, ARROW[:3]]))
        signed = covered(mesh)[:, 2]
        assert mesh.faces[:2].tolist() == [[0, 1, 2], [0, 2, 3]]
        mine = signed[2:-1]
        assert len(mine) == len(polygon) - 2 and bool((mine.sign() == np.sign(area(polygon))).all())
        assert float(mine.sum()) == pytest.approx(area(polygon), rel=1e-6)


def test_the_silhouette_of_a_c(tmp_path):
    mesh = eg.load_mesh(written(tmp_path, "obj", [C]))
    camera = eg.Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.5, size=(50, 50))
    alpha = eg.render_aovs(mesh, camera, ["alpha"], seed=0)["alpha"]
    assert float(alpha.sum()) == pytest.approx(0.52 * 40**2, abs=1e-3)


def test_in_any_plane_of_space(tmp_path):
    """The plane is rotated about an axis that is none of the file's."""
    axis = np.array([1.0, 2.0, 3.0]) / math.sqrt(14.0)
    cross = np.cross(np.eye(3), axis)
    for angle in np.linspace(0.1, 6.2, 7):
        R = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
        verts = np.pad(np.array(C), ((0, 0), (0, 1))) @ R.T
        path = tmp_path / "a.obj"
        path.write_text("".join("v {} {} {}\n".format(*v) for v in verts) + "f 1 2 3 4 5 6 7 8\n")
        areas = covered(eg.load_mesh(path)).numpy()
        np.testing.assert_allclose(areas.sum(0), area(C) * R[:, 2], atol=1e-6)
        assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(abs(area(C)), rel=1e-6)


def test_the_side_of_a_face_does_not_depend_on_earcut(tmp_path, monkeypatch):
    """earcut promises no orientation."""
    split = mapbox_earcut.triangulate_float64
    monkeypatch.setattr(
        mapbox_earcut, "triangulate_float64", lambda *given: split(*given).reshape(-1, 3)[:, ::-1].reshape(-1)
    )
    for polygon in (C, C[::-1]):
        assert float(covered(eg.load_mesh(written(tmp_path, "obj", [polygon])))[:, 2].sum()) == pytest.approx(
            area(polygon)
        )


def test_texture_coordinates_follow_their_corners(tmp_path):
    lines = [f"v {x} {y} 0\nvt {x / 10 + 0.5} {y / 10 + 0.5}" for x, y in C]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\nf " + " ".join(f"{i}/{i}" for i in range(1, 9)))
    mesh = eg.load_mesh(tmp_path / "a.obj")
    np.testing.assert_allclose(mesh.uvs[mesh.uv_faces], mesh.verts[mesh.faces][..., :2] / 10 + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    "polygon",
    [
        [[0, 0], [2, 2], [2, 0], [0, 2]],  # halves that cancel
        [[0, 0], [2, 2], [3, 0], [0, 2]],
        [[math.cos(0.8 * math.pi * i), math.sin(0.8 * math.pi * i)] for i in range(5)],  # every corner is convex
        [[0, 0], [4, 0], [4, 4], [2, -2], [0, 4]],
    ],
)
def test_faces_that_cross_themselves_are_named(tmp_path, polygon):
    path = written(tmp_path, "obj", [ARROW, polygon, polygon])
    with pytest.warns(UserWarning, match="2 faces that cross themselves, the first of them face 1, counted from 0"):
        assert len(eg.load_mesh(path).faces) >= 4


def test_corners_of_180_degrees_and_bent_quads_stay_fans(tmp_path):
    """No corner is concave but for the last digit, which a file rounds."""
    flat = [[0, 0], [1, 1e-9], [2, 0], [2, 2], [1, 2 - 1e-9], [0, 2]]
    assert eg.load_mesh(written(tmp_path, "obj", [flat])).faces.tolist() == [[0, i, i + 1] for i in range(1, 5)]
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0.4\nv 1 1 0\nv 0 1 0.4\nf 1 2 3 4\n")
    assert eg.load_mesh(tmp_path / "a.obj").faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("kind", ["obj", "off"])
def test_one_face_of_many_corners_among_many(tmp_path, kind):
    """A table of all faces, as wide as the widest, would take 128 MB."""
    circle = [[math.cos(2 * math.pi * i / 4000), math.sin(2 * math.pi * i / 4000)] for i in range(4000)]
    path = written(tmp_path, kind, [C, circle] + [[corner[:2] for corner in SQUARE]] * 4000)
    tracemalloc.start()
    try:
        mesh = eg.load_mesh(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert float(covered(mesh)[:, 2].sum()) == pytest.approx(area(C) + area(circle) + 4000, rel=1e-6)
    assert peak < 40e6


def test_without_earcut_only_concave_faces_of_many_corners_fail(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mapbox_earcut", None)
    convex = [[math.cos(i), math.sin(i)] for i in range(6)]
    mesh = eg.load_mesh(written(tmp_path, "obj", [convex, ARROW]))
    assert float(covered(mesh)[:, 2].sum()) == pytest.approx(area(convex) + area(ARROW), rel=1e-6)
    with pytest.raises(
        ImportError, match=r"splitting concave faces .*edgegrad\[files\].*pip install 'edgegrad\[files\]'"
    ):
        eg.load_mesh(written(tmp_path, "obj", [C]))
