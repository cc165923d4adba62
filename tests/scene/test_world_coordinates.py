"""Positions that float32 cannot show apart, as in coordinates of a map, stay double; others are float32 as ever."""

import warnings

import numpy as np
import pytest
import torch
import trimesh
from mesh_files import glb, write_obj
from PIL import Image

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

UTM = np.array([5e5, 4.6e6, 120.0])  # metres east and north, and above the sea


def sphere():
    ball = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices, some of them 0.3 m apart
    return ball.vertices + UTM, ball.faces


def soup(verts, faces):
    return verts[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def write(folder, kind, verts, faces):
    path = folder / f"a.{kind.split('-')[-1]}"
    corners = "".join("3 {} {} {}\n".format(*f) for f in faces)
    rows = "".join("{!r} {!r} {!r}\n".format(*map(float, v)) for v in verts)
    if kind == "obj":
        path.write_text("".join(f"v {row}\n" for row in rows.split("\n") if row)
                        + "".join("f {} {} {}\n".format(*f) for f in faces + 1))  # fmt: skip
    elif kind == "off":
        path.write_text(f"OFF\n{len(verts)} {len(faces)} 0\n{rows}{corners}")
    elif kind == "stl":
        facets = "facet normal 0 0 0\nouter loop\n" + "vertex {!r} {!r} {!r}\n" * 3 + "endloop\nendfacet\n"
        body = "".join(facets.format(*map(float, t)) for t in verts[faces].reshape(-1, 9))
        path.write_text(f"solid a\n{body}endsolid a\n")
    else:
        how, kind_of = {"text-ply": ("ascii", "float"), "binary-ply": ("binary_big_endian", "double")}[kind]
        head = f"ply\nformat {how} 1.0\nelement vertex {len(verts)}\n"
        head += "".join(f"property {kind_of} {axis}\n" for axis in "xyz")
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        lists = np.zeros(len(faces), [("n", "u1"), ("i", ">i4", 3)])
        lists["n"], lists["i"] = 3, faces
        binary = verts.astype(">f8").tobytes() + lists.tobytes()
        path.write_bytes(head.encode() + (binary if how != "ascii" else (rows + corners).encode()))
    return path


@pytest.mark.parametrize("kind", ["obj", "off", "stl", "text-ply", "binary-ply"])
@pytest.mark.parametrize("form", ["welded", "soup"])
def test_vertices_stay_apart(tmp_path, kind, form):
    verts, faces = sphere()
    path = write(tmp_path, kind, *(soup(verts, faces) if form == "soup" else (verts, faces)))
    mesh = eg.load_mesh(path)
    assert mesh.verts.dtype == torch.float64 and mesh.verts.shape == (162, 3)
    np.testing.assert_array_equal(mesh.verts[mesh.faces].numpy(), verts[faces])
    assert eg.load_scene(path).meshes[0].verts.dtype == torch.float64


@pytest.mark.parametrize("kind", ["obj", "stl", "text-ply", "binary-ply"])
def test_float32_where_it_is_asked_for_welds_first_and_warns(tmp_path, kind):
    """No two vertices of the north that lie within half a metre differ in float32."""
    verts, faces = sphere()
    with pytest.warns(
        UserWarning,
        match=r"positions in float64 \(rounded by up to 0\.2\d, more than a millionth of the extent, as dtype says\)",
    ):
        mesh = eg.load_mesh(write(tmp_path, kind, *soup(verts, faces)), dtype=torch.float32)
    assert mesh.verts.dtype == torch.float32 and mesh.verts.shape == (162, 3)
    np.testing.assert_array_equal(mesh.verts[mesh.faces].numpy(), verts[faces].astype(np.float32))


@pytest.mark.parametrize("kind", ["obj", "off", "stl", "text-ply", "binary-ply"])
def test_what_float32_holds_stays_float32(tmp_path, kind, recwarn):
    """Numbers with all digits of a double, near the origin; and those of float32 with nine, far away."""
    verts, faces = sphere()
    mesh = eg.load_mesh(path := write(tmp_path, kind, verts - UTM + 1.0, faces))
    assert mesh.verts.dtype == torch.float32
    np.testing.assert_array_equal(mesh.verts[mesh.faces].numpy(), (verts - UTM + 1.0)[faces].astype(np.float32))
    double = eg.load_mesh(path, dtype=torch.float64)
    assert double.verts.dtype == torch.float64
    np.testing.assert_array_equal(double.verts[double.faces].numpy(), (verts - UTM + 1.0)[faces])
    far = (verts - UTM).astype(np.float32) + np.float32(300.0)
    assert eg.load_mesh(write(tmp_path, kind, far, faces)).verts.dtype == torch.float32
    assert not [w for w in recwarn if "float64" in str(w.message)]


def test_all_tensors_of_a_mesh_are_of_one_type(tmp_path):
    """A textured, lit one, whose parts share their texture."""
    path = write_obj(tmp_path, mtl="newmtl skin\nmap_Kd skin.png\nKe 1 1 1\nnewmtl other\nmap_Kd skin.png\n")
    moved = path.read_text().replace("v 0 0 0", "v 4600000.1 0 0").replace("v 1 0 0", "v 4600001.1 0 0")
    moved = (
        moved.replace("v 1 1 0", "v 4600001.1 1 0").replace("v 0 1 0", "v 4600000.1 1 0")
        + "usemtl other\nf 1/2 2/3 3/4\n"
    )
    path.write_text(moved + "vn 0 0 1\nf 1/2/1 2/3/1 3/4/1\n")
    with pytest.warns(UserWarning, match=r"normals \(vn\) that only some corners of a part have"):
        scene = eg.load_scene(path, lit=True)
    first, second = scene.meshes
    assert first.texture is second.texture
    for tensor in (first.verts, first.texture, first.uvs, first.material.emission, second.verts):
        assert tensor.dtype == torch.float64
    assert (
        eg.render(scene, eg.Camera.look_at((4600000.6, 0.5, 3), (4600000.6, 0.5, 0), size=(4, 4)), spp=1, seed=0).dtype
        == torch.float64
    )


def test_a_gltf_whose_nodes_are_far_away(tmp_path):
    """Its own numbers are float32, and their sum with the translation is not."""
    verts, faces = (v - UTM if i == 0 else v for i, v in enumerate(sphere()))
    own = verts.astype("<f4")
    tree = {
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "translation": UTM.tolist()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }  # fmt: skip
    (tmp_path / "a.glb").write_bytes(glb(tree, own, faces.reshape(-1).astype("<u4")))
    mesh = eg.load_mesh(tmp_path / "a.glb")
    assert mesh.verts.dtype == torch.float64 and mesh.verts.shape == (162, 3)
    np.testing.assert_array_equal(mesh.verts[mesh.faces], own.astype(np.float64)[faces] + UTM)


@pytest.mark.parametrize("dtype", [None, torch.float32, torch.float64])
@pytest.mark.parametrize("place, double", [((500000.30, 4600000.24, 2.7), True), ((0.3, 0.1, 1e7), False)])
def test_lights_are_as_precise_as_meshes(tmp_path, dtype, place, double):
    """The mesh's numbers are round here, so that only the light needs float64; one that is far from all may be rounded."""
    faces = np.array([0, 1, 2], "<u4")
    tree = {
        "nodes": [
            {"mesh": 0, "translation": [round(x) if double else 0 for x in place[:2]] + [0]},
            *({"extensions": {"KHR_lights_punctual": {"light": i}}, "translation": place} for i in range(3)),
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {"KHR_lights_punctual": {"lights": [
            {"type": "point", "color": [0.1, 0.2, 0.3]}, {"type": "spot", "spot": {}}, {"type": "directional"},
        ]}},
    }  # fmt: skip
    (tmp_path / "a.glb").write_bytes(glb(tree, np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), faces))
    with warnings.catch_warnings(record=True) as caught:
        loaded = eg.load_scene(tmp_path / "a.glb", lit=True, dtype=dtype)
    assert len(caught) == (double and dtype == torch.float32)
    expected = dtype or (torch.float64 if double else torch.float32)
    point, spot, sun = loaded.lights
    for tensor in (loaded.meshes[0].verts, point.position, point.color, spot.position, spot.direction, sun.direction):
        assert tensor.dtype == expected
    assert torch.equal(point.position, torch.tensor(place, dtype=expected)) and torch.equal(
        spot.position, point.position
    )
    assert torch.equal(point.color, torch.tensor([0.1, 0.2, 0.3], dtype=expected))


@pytest.mark.parametrize("kind", ["ply", "stl", "glb", "obj", "off"])
def test_formats_of_float32_say_that_they_round(tmp_path, kind):
    verts, faces = sphere()
    mesh = eg.Mesh(verts, faces)
    if kind in ("ply", "stl", "glb"):
        with pytest.warns(UserWarning, match=rf"a\.{kind} holds no positions beyond float32; torch\.save"):
            eg.save_mesh(tmp_path / f"a.{kind}", mesh)
        return
    eg.save_mesh(tmp_path / f"a.{kind}", mesh)
    np.testing.assert_array_equal(eg.load_mesh(tmp_path / f"a.{kind}").verts, verts)


def test_another_dtype_is_refused(tmp_path):
    with pytest.raises(TypeError, match=r"dtype: expected torch\.float32, torch\.float64 or None, got torch\.float16"):
        eg.load_mesh(write_obj(tmp_path), dtype=torch.float16)


def test_from_trimesh():
    verts, faces = sphere()
    texture = trimesh.visual.TextureVisuals(uv=np.zeros((len(verts), 2)), image=Image.new("RGB", (2, 2)))
    far = eg.shapes.from_trimesh(trimesh.Trimesh(verts, faces, visual=texture, process=False))
    assert {far.verts.dtype, far.uvs.dtype, far.texture.dtype} == {torch.float64}
    assert np.array_equal(far.verts[far.faces].numpy(), verts[faces])
    near = eg.shapes.from_trimesh(trimesh.Trimesh(verts - UTM, faces, process=False))
    assert near.verts.dtype is torch.float32
    assert len(near.verts) == len(far.verts) == 162
