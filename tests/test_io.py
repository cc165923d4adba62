"""Files in and out: every kind is made here, read back and compared number by number; every fault must be named."""

import io
import json
import logging
import os
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import edgegrad as eg
from edgegrad.camera.camera import Camera
from edgegrad.files.cameras import load_camera, save_camera
from edgegrad.files.image import linear_to_srgb, read_image, srgb_to_linear, write_image
from edgegrad.files.load import load_mesh, load_scene
from edgegrad.scene.scene import Scene

trimesh = pytest.importorskip("trimesh")

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
TRIANGLES = [[0, 1, 2], [0, 2, 3]]
TEXELS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [128, 64, 32]]], np.uint8)  # row 0 on top


def linear(value):
    """The definition in IEC 61966-2-1, in float64."""
    s = np.asarray(value, np.float64) / 255.0
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def texel_at(mesh, face, corner):
    """The texel of a small texture in whose cell a corner's texture coordinate lies, v running up."""
    u, v = mesh.uvs[mesh.uv_faces[face, corner]].tolist()
    h, w, _ = mesh.texture.shape
    return mesh.texture[int((1.0 - v) * h), int(u * w)].numpy()


def write_obj(folder, name="quad.obj", mtl="newmtl skin\nmap_Kd skin.png\n", body=None):
    """A square of two triangles whose corners lie in the middles of the four texels; indices of their own."""
    Image.fromarray(TEXELS).save(folder / "skin.png")
    (folder / "quad.mtl").write_text(mtl)
    body = body or (
        "mtllib quad.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        "vt 0.25 0.75\nvt 0.25 0.25\nvt 0.75 0.25\nvt 0.75 0.75\nusemtl skin\nf 1/2 2/3 3/4\nf 1/2 3/4 4/1\n"
    )
    (folder / name).write_text(body)
    return folder / name


def glb(tree, *arrays):
    """A GLB file; accessors and buffer views follow from the arrays, bytes become buffer views only."""
    views, accessors, blob = [], [], b""
    for array in arrays:
        content = array if isinstance(array, bytes) else array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(content)})
        if not isinstance(array, bytes):
            kinds = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}
            shape = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
            accessors.append(
                {
                    "bufferView": len(views) - 1,
                    "componentType": kinds[array.dtype.str[1:]],
                    "count": len(array),
                    "type": shape,
                    "normalized": array.dtype.kind == "u" and array.ndim == 2,
                }
            )
        blob += content + b"\0" * (-len(content) % 4)
    tree = {
        "asset": {"version": "2.0"},
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
        **tree,
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def square_glb(material=None, nodes=None, colors=None, uv=False, extra=(), **more):
    """The square as a GLB file, with attributes and nodes as a test needs them."""
    arrays = [np.array(SQUARE, "<f4"), np.array(TRIANGLES, "<u2").reshape(-1)]
    attributes = {"POSITION": 0}
    if uv:
        # Origin at the top left, as in glTF: vertex 0, below on the left, lies in the texel of row 1, column 0.
        arrays.append(np.array([[0.25, 0.75], [0.75, 0.75], [0.75, 0.25], [0.25, 0.25]], "<f4"))
        attributes["TEXCOORD_0"] = len(arrays) - 1
    if colors is not None:
        arrays.append(colors)
        attributes["COLOR_0"] = len(arrays) - 1
    primitive = {"attributes": attributes, "indices": 1, **({} if material is None else {"material": 0})}
    tree = {
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes or [0])))}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        **({} if material is None else {"materials": [material]}),
        **more,
    }
    return glb(tree, *arrays, *extra)


def png_bytes():
    stream = io.BytesIO()
    Image.fromarray(TEXELS).save(stream, "PNG")
    return stream.getvalue()


def ply(vertices, faces, vertex_colors=None, face_colors=None, binary=False, comment=""):
    rgb = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    header = (
        f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\n{comment}element vertex {len(vertices)}\n"
        f"property float x\nproperty float y\nproperty float z\n{rgb if vertex_colors is not None else ''}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        f"{rgb if face_colors is not None else ''}end_header\n"
    ).encode()
    for i, v in enumerate(vertices):
        c = [] if vertex_colors is None else list(vertex_colors[i])
        header += struct.pack(f"<3f{len(c)}B", *v, *c) if binary else (" ".join(map(str, [*v, *c])) + "\n").encode()
    for i, f in enumerate(faces):
        c = [] if face_colors is None else list(face_colors[i])
        row = [len(f), *f, *c]
        header += struct.pack(f"<B{len(f)}i{len(c)}B", *row) if binary else (" ".join(map(str, row)) + "\n").encode()
    return header


# -- the sRGB curve ---------------------------------------------------------------------------------------------------


def test_srgb_curve_is_the_standard_s_and_inverts():
    codes = np.arange(256)
    got = srgb_to_linear(torch.tensor(codes / 255.0))
    np.testing.assert_allclose(got.numpy(), linear(codes), rtol=1e-12, atol=0)
    assert got[0] == 0.0 and got[255] == 1.0
    # The constants of the standard are rounded, so the two halves of the curve meet only to about 1e-6.
    np.testing.assert_allclose(linear_to_srgb(got).numpy() * 255, codes, rtol=0, atol=2e-4)
    assert float(srgb_to_linear(torch.tensor(0.5))) == pytest.approx(0.21404114, rel=1e-6)


def test_srgb_curve_has_finite_gradients_at_zero():
    for curve in (srgb_to_linear, linear_to_srgb):
        x = torch.zeros(3, requires_grad=True)
        curve(x).sum().backward()
        assert torch.isfinite(x.grad).all() and (x.grad > 0).all()


# -- meshes -----------------------------------------------------------------------------------------------------------


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
    """For a texture to come; and those that no texture can have are no fault of a file without one."""
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


def test_obj_vertex_colours_are_srgb(tmp_path):
    for name, scale in (("unit.obj", 255.0), ("byte.obj", 1.0)):
        rows = "".join(f"v {x} {y} {z} {128 / scale} {255 / scale} 0\n" for x, y, z in SQUARE)
        (tmp_path / name).write_text(rows + "f 1 2 3 4\n")
        mesh = load_mesh(tmp_path / name)
        assert mesh.faces.shape == (2, 3)
        np.testing.assert_allclose(mesh.colors.numpy(), np.tile(linear([128, 255, 0]), (4, 1)), atol=1e-6)


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


def test_obj_polygons_negative_indices_and_unused_vertices(tmp_path):
    body = "v 9 9 9\nv 0 0 0\nv 2 0 0\nv 3 1 0\nv 1 2 0\nv -1 1 0\nf -5 -4 -3 -2 -1\n"
    mesh = load_mesh(write_obj(tmp_path, body=body))
    assert mesh.verts.shape == (5, 3) and mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


def test_glb_with_an_embedded_texture(tmp_path):
    path = tmp_path / "square.glb"
    more = {"images": [{"bufferView": 3, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1.0, 0.125, 1.0]}
    path.write_bytes(square_glb({"pbrMetallicRoughness": base}, uv=True, extra=[png_bytes()], **more))
    mesh = load_mesh(path)
    expected = linear(TEXELS) * [0.5, 1.0, 0.125]
    np.testing.assert_allclose(mesh.texture.numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 0, 0), expected[1, 0], atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 1, 2), expected[0, 0], atol=1e-6)
    assert load_mesh(path, materials=False).channels is None


def test_textured_obj_and_glb_made_by_trimesh_agree(tmp_path):
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
    image = Image.fromarray(TEXELS)
    for name, material in (
        ("a.glb", trimesh.visual.material.PBRMaterial(baseColorTexture=image)),
        ("a.obj", trimesh.visual.material.SimpleMaterial(image=image)),
    ):
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        trimesh.Trimesh(SQUARE, TRIANGLES, visual=visual, process=False).export(tmp_path / name)
    for name in ("a.glb", "a.obj"):
        mesh = load_mesh(tmp_path / name)
        for vertex, texel in enumerate([(1, 0), (1, 1), (0, 1), (0, 0)]):
            face, corner = next((f, c) for f in range(2) for c in range(3) if TRIANGLES[f][c] == vertex)
            np.testing.assert_allclose(texel_at(mesh, face, corner), linear(TEXELS[texel]), atol=1e-6)


@pytest.mark.parametrize("dtype", ["<f4", "<u2", "|u1"])
def test_glb_vertex_colours_are_linear(tmp_path, dtype):
    shares = np.array([[0.2, 0.4, 0.6, 1.0]] * 3 + [[1.0, 0.0, 0.002, 0.5]])
    colors = shares.astype(dtype) if dtype == "<f4" else np.round(shares * np.iinfo(dtype).max).astype(dtype)
    (tmp_path / "c.glb").write_bytes(square_glb(colors=colors))
    step = 1e-7 if dtype == "<f4" else 0.5 / np.iinfo(dtype).max + 1e-7
    np.testing.assert_allclose(load_mesh(tmp_path / "c.glb").colors.numpy(), shares[:, :3], atol=step)
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 1.0, 1.0]}}
    (tmp_path / "m.glb").write_bytes(square_glb(material, colors=colors))
    np.testing.assert_allclose(load_mesh(tmp_path / "m.glb").colors.numpy(), shares[:, :3] * [0.5, 0.5, 1], atol=step)


def png_with_alpha(alpha):
    stream = io.BytesIO()
    Image.fromarray(np.concatenate([TEXELS, np.asarray(alpha, np.uint8)[..., None]], -1)).save(stream, "PNG")
    return stream.getvalue()


def cut_out_glb(alpha, sampler=None, **material):
    """The textured square with an alpha in its texture."""
    base = {"baseColorTexture": {"index": 0}, **material.pop("base", {})}
    more = {} if sampler is None else {"samplers": [sampler]}
    return square_glb(
        material={"pbrMetallicRoughness": base, **material}, uv=True, extra=(png_with_alpha(alpha),),
        images=[{"bufferView": 3, "mimeType": "image/png"}],
        textures=[{"source": 0, **({} if sampler is None else {"sampler": 0})}], **more,
    )  # fmt: skip


def test_gltf_masks_and_samplers(tmp_path):
    alpha = np.array([[0, 255], [102, 153]])
    file = tmp_path / "s.glb"
    file.write_bytes(cut_out_glb(alpha))
    assert load_mesh(file).alpha is None  # opaque
    file.write_bytes(cut_out_glb(alpha, alphaMode="MASK"))
    mesh = load_mesh(file)
    assert (mesh.alpha_cutoff, mesh.wrap, mesh.filter) == (0.5, "repeat", "linear")
    np.testing.assert_allclose(mesh.alpha, alpha / 255.0, atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    assert load_mesh(file, materials=False).alpha is None
    sampler = {"wrapS": 33071, "wrapT": 33648, "magFilter": 9728, "minFilter": 9987}
    base = {"baseColorFactor": [1.0, 0.5, 1.0, 0.75]}
    file.write_bytes(cut_out_glb(alpha, sampler, base=base, alphaMode="MASK", alphaCutoff=0.3))
    mesh = load_mesh(file)
    assert (mesh.alpha_cutoff, mesh.wrap, mesh.filter) == (0.3, ("clamp", "mirror"), "nearest")
    np.testing.assert_allclose(mesh.alpha, 0.75 * alpha / 255.0, atol=1e-6)
    # One texel of four is there, and a ray through another meets nothing.
    camera = eg.Camera.look_at([0.5, 0.5, 2.0], [0.5, 0.5, 0.0], size=(8, 8), fov_y=20.0)
    seen = eg.render_aovs(mesh, camera, ["alpha"], 16)["alpha"]
    assert 0.0 < seen.mean() < 1.0
    del sampler["wrapS"], sampler["magFilter"]
    file.write_bytes(cut_out_glb(alpha, sampler, alphaMode="MASK"))
    assert (load_mesh(file).wrap, load_mesh(file).filter) == (("repeat", "mirror"), "linear")
    file.write_bytes(cut_out_glb(alpha, {"wrapS": 1}))
    with pytest.raises(ValueError, match=r"expected a sampler of glTF 2\.0 for the texture .* got wraps \[1, 10497\]"):
        load_mesh(file)


def test_gltf_masks_without_alpha_in_a_texture(tmp_path):
    file = tmp_path / "s.glb"
    for opacity, shows in ((0.7, True), (0.2, False)):
        for uv in (True, False):
            base = {"baseColorFactor": [1.0, 1.0, 1.0, opacity]}
            file.write_bytes(square_glb(material={"pbrMetallicRoughness": base, "alphaMode": "MASK"}, uv=uv))
            camera = eg.Camera.look_at([0.5, 0.5, 2.0], [0.5, 0.5, 0.0], size=(8, 8), fov_y=20.0)
            seen = eg.render_aovs(load_mesh(file), camera, ["alpha"], 4)["alpha"].mean()
            assert seen == (1.0 if shows else 0.0)


@pytest.mark.parametrize("type_", ["<f4", "<u1", "<u2"])
def test_gltf_masks_by_alpha_of_vertices(tmp_path, type_):
    """Alpha rises from 0 to 1 from left to right; times 0.8 it is above a half right of 5/8."""
    scale = 1 if type_ == "<f4" else np.iinfo(type_).max
    colors = (np.array([[1, 1, 1, x] for x, _, _ in SQUARE]) * scale).astype(type_)
    K = torch.tensor([[32.0, 0, 0], [0, 32, 0], [0, 0, 1]])
    camera = eg.Camera(torch.eye(4), K, (32, 32), "orthographic")
    base = {"baseColorFactor": [1.0, 1.0, 1.0, 0.8]}
    file = tmp_path / "s.glb"
    for uv in (False, True):
        file.write_bytes(square_glb({"pbrMetallicRoughness": base, "alphaMode": "MASK"}, colors=colors, uv=uv))
        mesh = load_mesh(file)
        uvs = mesh.uvs.double().requires_grad_()
        seen = eg.render_aovs(mesh.replace(uvs=uvs).to(torch.float64), camera, ["alpha"], 64)["alpha"]
        assert seen.mean().item() == pytest.approx(0.375, abs=2e-3)
        assert seen[:, 0].mean() == 0 and seen[:, -1].mean() == 1
        # A larger alpha everywhere: the border at x = cutoff / 0.8 − δ / 0.8 moves left.
        (by_uv,) = torch.autograd.grad(seen.mean(), uvs)
        assert by_uv[:, 0].sum().item() == pytest.approx(1 / (0.5 * 0.8), rel=1e-3)
    file.write_bytes(square_glb({"pbrMetallicRoughness": base}, colors=colors))
    assert load_mesh(file).alpha is None  # opaque
    same = colors.copy()
    for share, shown in ((0.5, 0.0), (0.75, 1.0)):  # 0.4 and 0.6 in all
        same[:, 3] = np.array(share * scale).astype(type_)
        file.write_bytes(square_glb({"pbrMetallicRoughness": base, "alphaMode": "MASK"}, colors=same))
        assert eg.render_aovs(load_mesh(file), camera, ["alpha"], 4)["alpha"].mean() == shown


def test_gltf_masks_by_a_texture_and_by_vertices(tmp_path):
    base = {"baseColorTexture": {"index": 0}}
    colors = np.array([[1, 1, 1, x] for x, _, _ in SQUARE], "<f4")
    file = tmp_path / "s.glb"
    parts = dict(
        material={"pbrMetallicRoughness": base, "alphaMode": "MASK"}, uv=True, colors=colors,
        extra=(png_with_alpha([[0, 255], [102, 153]]),), images=[{"bufferView": 4, "mimeType": "image/png"}],
        textures=[{"source": 0}],
    )  # fmt: skip
    file.write_bytes(square_glb(**parts))
    with pytest.raises(ValueError, match=r"or the alpha of COLOR_0 to cut out, got both; bake"):
        load_mesh(file)
    file.write_bytes(square_glb(**{**parts, "colors": np.array([[1, 1, 1, 0.9]] * 4, "<f4")}))
    np.testing.assert_allclose(load_mesh(file).alpha, 0.9 * np.array([[0, 255], [102, 153]]) / 255.0, atol=1e-6)
    file.write_bytes(square_glb(**{**parts, "colors": np.array([[1, 1, 1, 1.5]] * 4, "<f4")}))
    with pytest.raises(ValueError, match=r"expected alpha of COLOR_0 from 0 to 1, got 1\.5 at vertex 0"):
        load_mesh(file)


def test_glb_base_colour_is_linear_and_not_rounded(tmp_path):
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.001, 0.3, 0.7, 1.0]}}
    (tmp_path / "f.glb").write_bytes(square_glb(material))
    np.testing.assert_allclose(load_mesh(tmp_path / "f.glb").face_colors.numpy(), [[0.001, 0.3, 0.7]] * 2, rtol=1e-6)
    (tmp_path / "d.glb").write_bytes(square_glb({}))
    assert load_mesh(tmp_path / "d.glb").face_colors.tolist() == [[1, 1, 1]] * 2  # what the format says of no factor


def test_glb_nodes_place_their_parts(tmp_path):
    turn = [0.0, 0.0, 2**-0.5, 2**-0.5]  # a quarter turn about z, as (x, y, z, w)
    nodes = [
        {"mesh": 0, "translation": [5, 0, 0], "children": [1]},
        {"mesh": 0, "scale": [2, 2, 2], "rotation": turn},
        {"mesh": 0, "scale": [-1, 1, 1]},
    ]
    (tmp_path / "n.glb").write_bytes(square_glb(nodes=nodes, scenes=[{"nodes": [0, 2]}]))
    scene = load_scene(tmp_path / "n.glb")
    assert isinstance(scene, Scene) and len(scene.meshes) == 3
    corners = sorted(mesh.verts[mesh.faces[0, 1]].tolist() for mesh in scene.meshes)
    np.testing.assert_allclose(corners, [[-1, 0, 0], [5, 2, 0], [6, 0, 0]], atol=1e-6)
    for mesh in scene.meshes:  # the mirrored one too still shows its front
        a, b, c = mesh.verts[mesh.faces[0]]
        assert torch.linalg.cross(b - a, c - a)[2] > 0
    assert load_mesh(tmp_path / "n.glb").faces.shape == (6, 3)


def test_parts_that_look_different_need_a_scene(tmp_path):
    scene = trimesh.Scene()
    for name, color in (("red", [255, 0, 0, 255]), ("none", None)):
        box = trimesh.creation.box()
        if color:
            box.visual.vertex_colors = color
        scene.add_geometry(box, geom_name=name, transform=trimesh.transformations.translation_matrix([len(name), 0, 0]))
    scene.export(tmp_path / "two.glb")
    with pytest.raises(ValueError, match=r"two\.glb: expected one mesh, got 2 parts \('red', 'none'\).*load_scene"):
        load_mesh(tmp_path / "two.glb")
    red, none = load_scene(tmp_path / "two.glb").meshes
    assert red.colors.shape == (8, 3) and none.colors is None
    np.testing.assert_allclose([m.verts.mean(0)[0].item() for m in (red, none)], [3, 4], atol=1e-6)


def test_merging_welds_across_parts(tmp_path):
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.creation.box().apply_translation([1, 0, 0])])
    scene.export(tmp_path / "boxes.glb")
    assert load_mesh(tmp_path / "boxes.glb").verts.shape == (12, 3)


def test_gltf_with_files_beside_it(tmp_path):
    whole = square_glb(
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        uv=True,
        images=[{"uri": "my%20skin.png"}],
        textures=[{"source": 0}],
    )
    size = struct.unpack("<I", whole[12:16])[0]
    tree = json.loads(whole[20 : 20 + size])
    tree["buffers"][0]["uri"] = "data.bin"
    (tmp_path / "s.gltf").write_text(json.dumps(tree))
    with pytest.raises(FileNotFoundError, match=r"s\.gltf: names 'data\.bin'"):
        load_mesh(tmp_path / "s.gltf")
    (tmp_path / "data.bin").write_bytes(whole[28 + size :])
    with pytest.raises(FileNotFoundError, match=r"s\.gltf: names 'my%20skin\.png'"):
        load_mesh(tmp_path / "s.gltf")
    Image.fromarray(TEXELS).save(tmp_path / "my skin.png")
    np.testing.assert_allclose(texel_at(load_mesh(tmp_path / "s.gltf"), 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    tree["images"][0]["uri"] = "../my skin.png"
    (tmp_path / "s.gltf").write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=r"s\.gltf.*'\.\./my skin\.png', outside its folder"):
        load_mesh(tmp_path / "s.gltf")


@pytest.mark.parametrize("binary", [False, True])
def test_ply_colours(tmp_path, binary):
    colors = [[0, 1, 10], [11, 128, 255], [200, 100, 50], [3, 2, 1]]
    (tmp_path / "v.ply").write_bytes(ply(SQUARE, TRIANGLES, vertex_colors=colors, binary=binary))
    np.testing.assert_allclose(load_mesh(tmp_path / "v.ply").colors.numpy(), linear(colors), atol=1e-7)
    (tmp_path / "f.ply").write_bytes(ply(SQUARE, TRIANGLES, face_colors=colors[:2], binary=binary))
    np.testing.assert_allclose(load_mesh(tmp_path / "f.ply").face_colors.numpy(), linear(colors[:2]), atol=1e-7)
    (tmp_path / "q.ply").write_bytes(ply(SQUARE, [[0, 1, 2, 3]], face_colors=colors[:1], binary=binary))
    quad = load_mesh(tmp_path / "q.ply")
    np.testing.assert_allclose(quad.face_colors.numpy(), linear([colors[0]] * 2), atol=1e-7)


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


# -- faults of meshes -------------------------------------------------------------------------------------------------

GOOD = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
)
MIXED = ply([*SQUARE, [2, 2, 0]], [[0, 1, 2, 3], [0, 1, 4]], face_colors=[[1, 2, 3]] * 2)


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("a.xyz", "1 2 3", "ends in .obj, .gltf"),
        ("a.pkl", b"\x80\x04N.", "ends in .obj, .gltf"),
        ("a", GOOD, "'no ending'"),
        ("a.obj", "", "an empty file"),
        ("a.obj", "# nothing\n", "expected triangles, got none"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "expected triangles, got none"),
        ("a.obj", GOOD + "f 1 2 9\n", "cannot be read"),
        ("a.obj", GOOD + "f 0 1 2\n", "count from 1, got 0"),
        ("a.obj", GOOD + "f 1 2 -7\n", "cannot be read"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 1 1 0\nf -3 -2 -1\n", "negative indices"),
        ("a.obj", GOOD + "f 1 x 3\nf 1 2 3\n", "cannot be read"),
        ("a.obj", GOOD + "f 1 2\n", "the 2 faces that the file announces, got 1"),
        ("a.obj", GOOD.replace("v 0 1 0", "v 0 nan 0"), "finite positions.* at vertex 2"),
        ("a.obj", GOOD.replace("v 0 1 0", "v 0 1e99 0"), "finite positions.* at vertex 2"),
        ("a.obj", "v 0 0 0 0 0 0\nv 1 0 0 0 nan 0\nv 0 1 0 1 1 1\nf 1 2 3\n", "vertex colours.*nan.* at vertex 1"),
        ("a.obj", "v 0 0 0 0 0 0\nv 1 0 0 0 -1 0\nv 0 1 0 1 1 1\nf 1 2 3\n", "vertex colours.*-1.* at vertex 1"),
        ("a.obj", "mtllib a.mtl\nmtllib b.mtl\n" + GOOD, "several"),
        ("a.obj", "mtllib ../a.mtl\n" + GOOD, r"'\.\./a\.mtl', outside its folder"),
        ("a.obj", "mtllib /etc/passwd\n" + GOOD, "'/etc/passwd', outside its folder"),
        ("a.obj", "mtllib C:\\a.mtl\n" + GOOD, "outside its folder"),
        ("a.off", OFF.replace("3 0 1 2", "3 0 1 5"), "cannot be read"),
        ("a.off", OFF.replace("3 1 0", "3 2 0"), "the 2 faces that the file announces, got 1"),
        ("a.off", OFF[:20], "cannot be read"),
        ("a.off", "hello", "cannot be read"),
        ("a.stl", STL[:60], "expected triangles, got none"),
        ("a.stl", STL + STL[:-9], "the 2 faces that the file announces, got 1"),
        ("a.stl", b"\0" * 80 + struct.pack("<I", 3) + b"\0" * 60, "expected triangles, got none"),
        ("a.stl", STL.replace("vertex 0 1 0", "vertex 0 inf 0"), "finite positions"),
        ("a.ply", ply(SQUARE, []), "expected triangles, got none"),
        ("a.ply", ply(SQUARE, TRIANGLES)[:-10], "truncated"),
        ("a.ply", ply(SQUARE, TRIANGLES)[:-20], "truncated"),
        ("a.ply", ply(SQUARE, TRIANGLES, binary=True)[:-4], "cannot be read"),
        ("a.ply", ply(SQUARE, TRIANGLES)[:60], "cannot be read"),
        ("a.ply", ply(SQUARE, [[0, 1, 4]]), "indices from 0 to 3, got 4"),
        ("a.ply", ply(SQUARE, [[0, 1, -1]], binary=True), "indices from 0 to 3, got -1"),
        ("a.ply", ply([[0, 0, 0], [1, 0, 0], [0, float("nan"), 0]], [[0, 1, 2]], binary=True), "finite positions"),
        ("a.ply", MIXED, "expected 3 colours for 3 triangles, got 2"),
        ("a.glb", b"glTF", "something else"),
        ("a.glb", square_glb()[:60], "cannot be read"),
        ("a.glb", square_glb()[:-8], "cannot be read"),
        ("a.glb", square_glb(scenes=[{"nodes": []}]), "expected triangles, got none"),
        ("a.glb", square_glb(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        ("a.glb", square_glb(materials=5), "cannot be read"),
        ("a.glb", square_glb(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6}]}]), "a triangle fan"),
        ("a.gltf", "{", "cannot be read"),
        ("a.gltf", "[]", "JSON object"),
        ("a.3mf", b"PK\x03\x04 not a zip", "cannot be read"),
    ],
)
def test_faults_are_named(tmp_path, name, content, fault):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for load in (load_mesh, load_scene):
        with pytest.raises(ValueError, match=fault) as caught:
            load(path)
        assert str(caught.value).startswith(str(path))


def test_path_faults(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.obj: expected a file"):
        load_mesh(tmp_path / "gone.obj")
    with pytest.raises(ValueError, match="got a directory"):
        load_mesh(tmp_path)
    with pytest.raises(ValueError, match="ends in"):
        load_mesh("http://127.0.0.1/mesh")
    with pytest.raises(FileNotFoundError, match=r"127\.0\.0\.1"):
        load_mesh("http://127.0.0.1/mesh.obj")
    with pytest.raises(TypeError, match="path: expected a str"):
        load_mesh(3)


def test_texture_faults(tmp_path):
    path = write_obj(tmp_path)
    (tmp_path / "skin.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"quad\.obj: names 'skin\.png'.*materials=False"):
        load_mesh(path)
    assert load_mesh(path, materials=False).texture is None
    (tmp_path / "skin.png").write_bytes(b"not an image")
    with pytest.raises(ValueError, match=r"quad\.obj.*image in the texture 'skin\.png'"):
        load_mesh(path)
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "skin.png")
    whole = (tmp_path / "skin.png").read_bytes()
    (tmp_path / "skin.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"quad\.obj.*whole image in the texture 'skin\.png'"):
        load_mesh(path)
    (tmp_path / "quad.mtl").unlink()
    with pytest.raises(FileNotFoundError, match=r"quad\.obj: names 'quad\.mtl'"):
        load_mesh(path)
    for name in ("../skin.png", str(tmp_path / "skin.png"), "..\\skin.png"):
        path = write_obj(tmp_path, mtl=f"newmtl skin\nmap_Kd {name}\n")
        with pytest.raises(ValueError, match=r"quad\.obj.*outside its folder"):
            load_mesh(path)
    path = write_obj(tmp_path, body="mtllib quad.mtl\nusemtl skin\n" + GOOD)
    with pytest.raises(ValueError, match=r"quad\.obj.*expected texture coordinates"):
        load_mesh(path)


def test_a_link_out_of_the_folder_is_not_followed(tmp_path):
    (tmp_path / "inside").mkdir()
    path = write_obj(tmp_path / "inside")
    (tmp_path / "inside" / "skin.png").rename(tmp_path / "skin.png")
    os.symlink(tmp_path / "skin.png", tmp_path / "inside" / "skin.png")
    with pytest.raises(ValueError, match="outside its folder"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"images": [{"bufferView": 0, "name": "bark"}]}, "image in the texture 'bark'"),
        (
            {"colors": np.eye(4, dtype="<f4")},
            r"vertex colours that differ, got both.*load it with lit=True, which multiplies them, or materials=False",
        ),
        ({"uv": False}, "expected texture coordinates"),
        ({"reference": {"index": 0, "texCoord": 1}}, "expected texture coordinates TEXCOORD_1"),
        ({"images": [{"uri": "gone.png"}]}, "names 'gone.png'"),
    ],
)
def test_gltf_texture_faults(tmp_path, change, fault):
    options = {"uv": True, "extra": [png_bytes()], "textures": [{"source": 0}], **change}
    base = {"baseColorTexture": options.pop("reference", {"index": 0})}
    view = 2 + bool(options["uv"]) + ("colors" in options)
    options.setdefault("images", [{"bufferView": view}])
    (tmp_path / "t.glb").write_bytes(square_glb({"pbrMetallicRoughness": base}, **options))
    with pytest.raises((ValueError, FileNotFoundError), match=rf"t\.glb.*{fault}"):
        load_mesh(tmp_path / "t.glb")


def test_gltf_vertex_colours_beside_a_texture(tmp_path):
    """Multiplied where they are all one. Others need a lit mesh, or the texture left out."""
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1.0, 0.2, 1.0]}
    given = dict(uv=True, extra=[png_bytes()], textures=[{"source": 0}], images=[{"bufferView": 4}])
    file, colors = tmp_path / "t.glb", np.array([[0.5, 0.25, 1.0, 1.0]] * 4, "<f4")

    def save(colors, **material):
        file.write_bytes(square_glb({"pbrMetallicRoughness": base, **material}, colors=colors, **given))

    save(colors)
    mesh = load_mesh(file)
    expected = srgb_to_linear(torch.from_numpy(TEXELS) / 255.0) * torch.tensor([0.25, 0.25, 0.2])
    torch.testing.assert_close(mesh.texture, expected, check_dtype=False)
    assert mesh.colors is None
    colors[0, 0] = 0.75
    save(colors)
    torch.testing.assert_close(load_mesh(file, materials=False).colors, torch.from_numpy(colors[:, :3]))
    lit = load_mesh(file, lit=True)
    torch.testing.assert_close(lit.colors, torch.from_numpy(colors[:, :3]))
    assert lit.material.base_color.image.shape == (2, 2, 3)
    save(colors, extensions={"KHR_materials_unlit": {}})
    with pytest.raises(ValueError, match=r"got both.*; load it with materials=False"):
        load_mesh(file, lit=True)


# -- images -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "exr", "hdr", "jpg"])
def test_image_round_trip(tmp_path, suffix):
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(6, 9, 3, generator=generator)
    if suffix == "jpg":  # smooth, since JPEG keeps little else
        image = image[:1, :1].expand(16, 24, 3) * torch.linspace(0.5, 1, 24)[:, None]
    path = tmp_path / f"a.{suffix}"
    write_image(path, image)
    back = read_image(path)
    assert back.dtype == torch.float32 and back.shape == image.shape and back.is_contiguous()
    if suffix == "exr":
        assert torch.equal(back, image)
    elif suffix == "hdr":
        assert ((back - image).abs() <= image.amax(-1, keepdim=True) / 128).all()  # one exponent for three channels
    else:
        steps = (linear_to_srgb(back) - linear_to_srgb(image)).abs() * 255
        assert float(steps.max()) <= (3.0 if suffix == "jpg" else 0.5001)
    assert [file.name for file in tmp_path.iterdir()] == [f"a.{suffix}"]  # no temporary file is left


def test_png_values_are_srgb_rounded_to_nearest_and_clipped(tmp_path):
    codes = torch.arange(256, dtype=torch.float64)
    shifted = torch.stack([codes - 0.49, codes, codes + 0.49]) / 255
    write_image(tmp_path / "r.png", srgb_to_linear(shifted))
    stored = np.asarray(Image.open(tmp_path / "r.png"))
    np.testing.assert_array_equal(stored, np.tile(np.arange(256), (3, 1)))
    np.testing.assert_allclose(read_image(tmp_path / "r.png")[0, :, 0].numpy(), linear(np.arange(256)), atol=2e-7)
    write_image(tmp_path / "c.png", torch.tensor([[-1.0, 7.0, 0.5]]))
    assert np.asarray(Image.open(tmp_path / "c.png")).tolist() == [[0, 255, 188]]


def test_alpha_is_kept_apart(tmp_path):
    stored = np.array([[[200, 100, 50, 128], [255, 255, 255, 0], [1, 2, 3, 255]]], np.uint8)
    Image.fromarray(stored).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(image[..., :3].numpy(), linear(stored[..., :3]), atol=1e-6)
    np.testing.assert_allclose(image[..., 3].numpy(), stored[..., 3] / 255.0, atol=1e-6)
    assert torch.equal(read_image(tmp_path / "a.png", channels=3), image[..., :3])
    write_image(tmp_path / "b.png", image)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "b.png")), stored)
    grey = torch.tensor([[[0.5, 0.25], [0.1, 1.0]]])
    write_image(tmp_path / "la.png", grey)
    np.testing.assert_allclose(read_image(tmp_path / "la.png").numpy(), grey.numpy(), atol=5e-3)


def test_kinds_of_png(tmp_path):
    stored = np.random.default_rng(2).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    palette = Image.fromarray(stored).convert("P")
    palette.save(tmp_path / "palette.png")
    expected = linear(np.asarray(palette.convert("RGB")))
    np.testing.assert_allclose(read_image(tmp_path / "palette.png").numpy(), expected, atol=1e-6)
    Image.fromarray(stored[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_allclose(read_image(tmp_path / "grey.png").numpy(), linear(stored[..., :1]), atol=1e-6)
    deep = np.random.default_rng(3).integers(0, 65536, (4, 5), dtype=np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    np.testing.assert_allclose(read_image(tmp_path / "deep.png")[..., 0].numpy(), linear(deep / 257.0), atol=1e-6)
    Image.fromarray(stored[..., 0] > 128).save(tmp_path / "bits.png")
    np.testing.assert_array_equal(read_image(tmp_path / "bits.png")[..., 0].numpy(), stored[..., 0] > 128)


def test_cmyk_jpeg_and_exif_orientation(tmp_path):
    stored = np.full((8, 8, 3), (200, 100, 50), np.uint8)
    Image.fromarray(stored).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=100)
    expected = linear(np.asarray(Image.open(tmp_path / "cmyk.jpg").convert("RGB")))
    np.testing.assert_allclose(read_image(tmp_path / "cmyk.jpg").numpy(), expected, atol=0.02)
    wide = Image.fromarray(np.random.default_rng(4).integers(0, 256, (3, 5, 3), dtype=np.uint8))
    exif = wide.getexif()
    exif[0x112] = 6  # to be shown turned clockwise by a quarter
    wide.save(tmp_path / "turned.png", exif=exif)
    expected = linear(np.rot90(np.asarray(wide), -1))
    np.testing.assert_allclose(read_image(tmp_path / "turned.png").numpy(), expected, atol=1e-6)


def test_channels_convert(tmp_path):
    write_image(tmp_path / "rgb.exr", torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.5]]]))
    grey = read_image(tmp_path / "rgb.exr", channels=1)
    np.testing.assert_allclose(grey[0, :, 0].numpy(), [0.2126, 0.7152, 0.5], atol=1e-6)
    assert read_image(tmp_path / "rgb.exr", channels=4)[0, 0].tolist() == [1, 0, 0, 1]
    write_image(tmp_path / "y.exr", torch.tensor([[0.25, 2.0]]))
    assert read_image(tmp_path / "y.exr").shape == (1, 2, 1)
    assert read_image(tmp_path / "y.exr", channels=3)[0, 1].tolist() == [2, 2, 2]
    write_image(tmp_path / "many.exr", torch.arange(24.0).reshape(1, 2, 12))
    assert torch.equal(read_image(tmp_path / "many.exr"), torch.arange(24.0).reshape(1, 2, 12))
    with pytest.raises(ValueError, match=r"many\.exr: expected 1 or 3 colour channels, got 12"):
        read_image(tmp_path / "many.exr", channels=3)
    with pytest.raises(ValueError, match="channels: expected None, 1, 3 or 4"):
        read_image(tmp_path / "y.exr", channels=2)


def test_write_image_takes_what_a_loop_has_at_hand(tmp_path):
    values = torch.rand(3, 4, 3, dtype=torch.float64, requires_grad=True)
    write_image(tmp_path / "a.exr", values)
    assert torch.equal(read_image(tmp_path / "a.exr"), values.detach().float())
    for image in (values.detach().numpy(), values.half(), values.bfloat16(), values.transpose(0, 1), values.flip(0)):
        write_image(tmp_path / "b.png", image)
    write_image(str(tmp_path / "c.PNG"), values[..., 0])
    assert read_image(tmp_path / "c.PNG").shape == (3, 4, 1)


def test_image_faults(tmp_path):
    image = torch.rand(3, 4, 3)
    with pytest.raises(ValueError, match=r"a\.gif: expected a file name that ends in \.png, \.jpg.*\.exr, \.hdr"):
        write_image(tmp_path / "a.gif", image)
    (tmp_path / "file").write_text("")
    with pytest.raises(
        OSError, match=r"a\.png: expected a folder to write to, got .*file \(Not a directory\)|File exists"
    ):
        write_image(tmp_path / "file" / "a.png", image)
    write_image(tmp_path / "new" / "folders" / "a.png", image)
    assert read_image(tmp_path / "new" / "folders" / "a.png").shape == (3, 4, 3)
    with pytest.raises(ValueError, match=r"img: expected finite numbers, got nan at \[1, 2, 0\]"):
        image_nan = image.clone()
        image_nan[1, 2, 0] = float("nan")
        write_image(tmp_path / "a.png", image_nan)
    with pytest.raises(TypeError, match=r"img: expected linear radiance of a floating dtype, got torch\.uint8"):
        write_image(tmp_path / "a.png", torch.zeros(2, 2, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="img: expected shape"):
        write_image(tmp_path / "a.png", torch.zeros(2))
    for suffix, channels in (("png", 5), ("jpg", 4), ("jpg", 2), ("hdr", 1), ("bmp", 2)):
        with pytest.raises(ValueError, match=rf"a\.{suffix}: expected .* channels in a .* file, got {channels}"):
            write_image(tmp_path / f"a.{suffix}", torch.zeros(2, 2, channels))
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match=r"folder\.png: expected a file name, got a directory"):
        write_image(tmp_path / "folder.png", image)
    with pytest.raises(ValueError, match=r"folder\.png: expected a file, got a directory"):
        read_image(tmp_path / "folder.png")
    (tmp_path / "folder.png").rmdir()
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        read_image(tmp_path / "gone.png")
    with pytest.raises(ValueError, match=r"a\.webm: expected a file name that ends in"):
        read_image(tmp_path / "a.webm")
    (tmp_path / "zero.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"zero\.png: expected data, got an empty file"):
        read_image(tmp_path / "zero.png")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "new", "zero.png"]


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "exr", "hdr"])
def test_damaged_images(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    write_image(path, torch.rand(64, 64, 3))
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 3], b"not an image at all"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.{suffix}: expected a whole image"):
            read_image(path)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    write_image(path, torch.zeros(2, 2, 3))
    before = path.read_bytes()

    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        write_image(path, torch.ones(2, 2, 3))
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


# -- cameras and the import -------------------------------------------------------------------------------------------


def test_camera_round_trip(tmp_path):
    eye = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    camera = Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=33.3, size=(120, 200))
    save_camera(tmp_path / "c.json", camera)
    back = load_camera(tmp_path / "c.json", dtype=torch.float64)
    assert torch.equal(back.world_to_camera, camera.world_to_camera) and torch.equal(back.K, camera.K)
    assert back.size == (120, 200) and back.projection == "perspective"
    assert load_camera(tmp_path / "c.json").K.dtype == torch.float32
    flat = Camera.orthographic((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), size=(8, 9))
    save_camera(tmp_path / "b.json", Camera.stack([flat, flat]))
    assert load_camera(tmp_path / "b.json").batch == 2
    assert load_camera(tmp_path / "b.json").projection == "orthographic"


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"K": None}, "K: expected this key"),
        ({"K": [[1, 0], [0, 1]]}, r"K: expected shape \(3, 3\)"),
        ({"K": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "K: expected rows of numbers"),
        ({"K": "identity"}, "K: expected rows of numbers"),
        ({"world_to_camera": np.diag([2.0, 2, 2, 2]).tolist()}, "world_to_camera: expected the last row"),
        ({"size": 5}, r"size: expected \[height, width\]"),
        ({"size": [0, 5]}, "size: expected an int from 1"),
        ({"projection": "fish"}, "projection: expected"),
        ({"colour": 1}, "colour: expected only the keys"),
        (b"{", "Expecting"),
        (b"[]", "expected a JSON object"),
        (b"\xff\xfe\x00", "codec"),
        (b"", "an empty file"),
    ],
)
def test_camera_faults(tmp_path, change, fault):
    path = tmp_path / "c.json"
    if isinstance(change, bytes):
        path.write_bytes(change)
    else:
        save_camera(path, Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0)))
        fields = {**json.loads(path.read_text()), **change}
        path.write_text(json.dumps({key: value for key, value in fields.items() if value is not None}))
    with pytest.raises(ValueError, match=fault) as caught:
        load_camera(path)
    assert str(caught.value).startswith(str(path))


def test_camera_path_faults(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.json"):
        load_camera(tmp_path / "gone.json")
    camera = Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"c\.txt: expected a file name that ends in \.json"):
        save_camera(tmp_path / "c.txt", camera)
    save_camera(tmp_path / "new" / "c.json", camera)
    assert load_camera(tmp_path / "new" / "c.json").size == camera.size
    with pytest.raises(TypeError, match="camera: expected a Camera, got dict"):
        save_camera(tmp_path / "c.json", {})


def test_libraries_are_imported_late_and_missed_by_name(tmp_path):
    write_image(tmp_path / "a.png", torch.zeros(1, 1, 3))
    (tmp_path / "a.obj").write_text(GOOD)
    code = (
        "import sys, edgegrad.io as io\n"
        "print({'trimesh', 'OpenImageIO', 'PIL', 'roma', 'viser', 'matplotlib', 'torch._dynamo'} & set(sys.modules))\n"
        "sys.modules.update({'OpenImageIO': None, 'trimesh': None, 'trimesh.exchange.load': None})\n"
        "for name, read in (('a.png', io.read_image), ('a.obj', io.load_mesh)):\n"
        "    try: read(name)\n"
        "    except ImportError as error: print(error)\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    text = subprocess.check_output([sys.executable, "-c", code], text=True, cwd=tmp_path, env=env)
    early, image, mesh = text.splitlines()
    assert early == "set()"
    assert "pip install OpenImageIO" in image and "pip install trimesh" in mesh


@pytest.mark.parametrize(
    "missing, names",
    [
        ("PIL", ["a.glb", "a.obj"]),
        pytest.param("lxml", ["a.3mf"], marks=pytest.mark.slow),
        pytest.param("networkx", ["a.3mf"], marks=pytest.mark.slow),
    ],
)
def test_missing_libraries_are_asked_for_by_their_extra(tmp_path, missing, names):
    for name in names:
        box = trimesh.creation.box()
        if missing == "PIL":
            box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], image=Image.new("RGB", (2, 2)))
        box.export(tmp_path / name)
        assert len(load_mesh(tmp_path / name).faces) == 12
    code = (
        f"import sys\nsys.modules['{missing}'] = None\nimport edgegrad as eg\nfor name in {names}:\n"
        "    try: eg.load_mesh(name)\n    except ImportError as error: print(error)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    text = subprocess.check_output([sys.executable, "-c", code], text=True, cwd=tmp_path, env=env)
    lines = text.splitlines()
    assert len(lines) == len(names)
    for line in lines:
        assert line.startswith("reading") and "pip install 'edgegrad[files]'" in line
