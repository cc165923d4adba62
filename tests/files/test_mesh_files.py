"""Meshes from OBJ, PLY, STL, OFF and 3MF files, which are made here and compared number by number."""

import logging
import re

import numpy as np
import pytest
import torch
from mesh_files import SQUARE, TEXELS, TRIANGLES, linear, ply, texel_at, write_obj
from PIL import Image

from edgegrad.files.load import load_mesh, load_scene

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]

trimesh = pytest.importorskip("trimesh")


def test_obj_with_texture_and_indices_of_its_own(tmp_path):
    mesh = load_mesh(write_obj(tmp_path))
    assert mesh.verts.dtype == torch.float32 and mesh.verts.is_contiguous() and mesh.faces.dtype == torch.int64
    assert mesh.verts.tolist() == SQUARE and mesh.faces.tolist() == TRIANGLES
    np.testing.assert_allclose(mesh.texture.numpy(), linear(TEXELS), atol=1e-6)
    # v runs up: vertex 0, at v = 0.25, shows the lower left texel, vertex 3, at v = 0.75, the upper left one.
    np.testing.assert_allclose(texel_at(mesh, 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 0, 1), linear(TEXELS[1, 1]), atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 1, 2), linear(TEXELS[0, 0]), atol=1e-6)


def test_vertices_stay_welded_at_a_texture_seam_and_a_crease(tmp_path):
    body = (
        "mtllib quad.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0.5 0\nvt 0.5 1\nvt 0 1\n"
        "vn 0 0 1\nvn 0 1 0\nusemtl skin\nf 1/1/1 2/2/1 3/3/1\nf 1/4/2 3/5/2 4/6/2\n"
    )
    mesh = load_mesh(write_obj(tmp_path, body=body))
    assert mesh.verts.shape == (4, 3) and mesh.uvs.shape == (6, 2)
    assert mesh.faces[0, 0] == mesh.faces[1, 0] and mesh.uv_faces[0, 0] != mesh.uv_faces[1, 0]
    np.testing.assert_allclose(mesh.uvs[mesh.uv_faces[1]].numpy(), [[0.5, 0], [0.5, 1], [0, 1]])
    np.testing.assert_allclose(mesh.verts[mesh.faces[1]].numpy(), np.array(SQUARE)[[0, 2, 3]])


@pytest.mark.parametrize("bad", [None, "nan", "1e10"])
def test_texture_coordinates_without_a_texture(tmp_path, bad):
    """They are kept for a later texture. Unusable ones are no fault of a file without a texture."""
    path = write_obj(tmp_path)
    plain = path.read_text().replace("mtllib quad.mtl\n", "").replace("usemtl skin\n", "")
    path.write_text(plain if bad is None else re.sub(r"(?m)^vt \S+", f"vt {bad}", plain, count=1))
    mesh = load_mesh(path)
    assert mesh.texture is None and mesh.channels is None and mesh.verts.tolist() == SQUARE
    if bad is not None:
        assert mesh.uvs is None
        return
    given = load_mesh(path, texture=tmp_path / "skin.png")
    textured = mesh.replace(texture=given.texture)
    for face, corner in np.ndindex(2, 3):
        np.testing.assert_array_equal(texel_at(textured, face, corner), texel_at(given, face, corner))


def test_obj_texture_given_by_hand(tmp_path):
    path = write_obj(tmp_path)
    path.write_text(path.read_text().replace("mtllib quad.mtl\n", ""))
    assert load_mesh(path).texture is None and load_mesh(path).channels is None
    mesh = load_mesh(path, texture=tmp_path / "skin.png")
    np.testing.assert_allclose(texel_at(mesh, 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    assert load_mesh(path, texture=torch.rand(3, 5, 1)).channels == 1
    (tmp_path / "plain.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"plain\.obj.*texture coordinates"):
        load_mesh(tmp_path / "plain.obj", texture=tmp_path / "skin.png")


def test_obj_parts(tmp_path):
    body = (
        "# mtllib nowhere.mtl\n  mtllib\tquad.mtl\no left\nv 0 0 0\nv 1 0 0 # a comment\nv 0 1 0\nusemtl red\nf 1 2 3\n"
        "o right\nv 2 0 0\nv 3 0 0\nv 2 1 0\nusemtl green\nf 4 5 6 # another\n"
    )
    path = write_obj(tmp_path, body=body, mtl="newmtl red\nKd 0.5 0 0\nnewmtl green\nKd 0 0.25 0\n")
    first, second = load_scene(path).meshes
    assert first.verts[0].tolist() == [0, 0, 0] and second.verts[0].tolist() == [2, 0, 0]
    assert first.face_colors.tolist() == [[0.5, 0, 0]] and second.face_colors.tolist() == [[0, 0.25, 0]]
    whole = load_mesh(path)
    assert whole.face_colors.tolist() == [[0.5, 0, 0], [0, 0.25, 0]] and whole.verts.shape == (6, 3)
    assert len(load_scene(path, materials=False).meshes) == 2 and load_mesh(path, materials=False).channels is None


def test_textured_obj_and_glb_made_by_trimesh_agree(tmp_path):
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
    image = Image.fromarray(TEXELS)
    for name, material in (
        ("a.glb", trimesh.visual.material.PBRMaterial(baseColorTexture=image)),
        ("a.obj", trimesh.visual.material.SimpleMaterial(image=image, diffuse=[255] * 4)),
    ):
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        trimesh.Trimesh(SQUARE, TRIANGLES, visual=visual, process=False).export(tmp_path / name)
    for name in ("a.glb", "a.obj"):
        mesh = load_mesh(tmp_path / name)
        for vertex, texel in enumerate([(1, 0), (1, 1), (0, 1), (0, 0)]):
            face, corner = next((f, c) for f in range(2) for c in range(3) if TRIANGLES[f][c] == vertex)
            np.testing.assert_allclose(texel_at(mesh, face, corner), linear(TEXELS[texel]), atol=1e-6)


def test_ply_copies_with_different_colours_are_welded(tmp_path):
    soup = [SQUARE[i] for face in TRIANGLES for i in face]
    colors = [[255, 0, 0]] * 3 + [[0, 0, 255]] * 3
    (tmp_path / "s.ply").write_bytes(ply(soup, [[0, 1, 2], [3, 4, 5]], vertex_colors=colors))
    mesh = load_mesh(tmp_path / "s.ply")
    assert mesh.verts.shape == (4, 3) and mesh.colors is None
    assert mesh.corner_colors.tolist() == [[[1, 0, 0]] * 3, [[0, 0, 1]] * 3]


def test_ply_texture(tmp_path):
    Image.fromarray(TEXELS).save(tmp_path / "skin.png")
    body = ply(SQUARE, TRIANGLES, comment="comment TextureFile skin.png\n").decode()
    body = body.replace("property float z\n", "property float z\nproperty float s\nproperty float t\n")
    uv = ["0.25 0.25", "0.75 0.25", "0.75 0.75", "0.25 0.75"]
    for v, t in zip(SQUARE, uv, strict=True):
        line = " ".join(map(str, v)) + "\n"
        body = body.replace(line, line.strip() + f" {t}\n", 1)
    (tmp_path / "t.ply").write_text(body)
    np.testing.assert_allclose(texel_at(load_mesh(tmp_path / "t.ply"), 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    (tmp_path / "skin.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"t\.ply: names 'skin\.png'"):
        load_mesh(tmp_path / "t.ply")
    assert load_mesh(tmp_path / "t.ply", materials=False).texture is None
    (tmp_path / "skin.png").write_text("no image")
    with pytest.raises(ValueError, match=r"t\.ply: expected an image in the texture 'skin\.png'"):
        load_mesh(tmp_path / "t.ply")
    # What trimesh logs about it, a traceback, does not reach the terminal unless logging is set up.
    assert any(isinstance(handler, logging.NullHandler) for handler in logging.getLogger("trimesh").handlers)
    Image.fromarray(TEXELS).save(tmp_path / "skin.png")
    (tmp_path / "u.ply").write_bytes(ply(SQUARE, TRIANGLES, comment="comment TextureFile skin.png\n"))
    with pytest.raises(ValueError, match=r"u\.ply.*texture coordinates.*'skin\.png'"):
        load_mesh(tmp_path / "u.ply")


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "off", "3mf"])
def test_shapes_without_colour(tmp_path, kind):
    sphere = trimesh.creation.icosphere(subdivisions=1)
    path = tmp_path / f"ball.{kind.split('_')[0]}"
    sphere.export(path, file_type=kind)
    mesh = load_mesh(path)
    assert mesh.verts.shape == (42, 3) and mesh.faces.shape == (80, 3) and mesh.channels is None
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).sort(1).values
    assert len(edges.unique(dim=0)) == 120  # closed: every edge once, shared by two faces
    np.testing.assert_allclose(mesh.verts.norm(dim=1).numpy(), 1.0, atol=1e-6)


def test_3mf_parts(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 4.0):
        scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([x, 0, 0]))
    scene.export(tmp_path / "two.3mf")
    centres = [mesh.verts.mean(0)[0].item() for mesh in load_scene(tmp_path / "two.3mf").meshes]
    np.testing.assert_allclose(sorted(centres), [0, 4], atol=1e-6)
