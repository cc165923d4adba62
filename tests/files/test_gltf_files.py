"""Meshes from glTF and GLB files, which are made here and compared number by number."""

import base64
import io
import json

import numpy as np
import pytest
import torch
from mesh_files import SQUARE, TEXELS, TRIANGLES, gltf_tree, linear, saved, square_glb, texel_at
from PIL import Image

import edgegrad as eg
from edgegrad.files.image import srgb_to_linear
from edgegrad.files.load import load_mesh, load_scene
from edgegrad.scene.scene import Scene

pytestmark = pytest.mark.unsanitized

trimesh = pytest.importorskip("trimesh")


def test_glb_with_an_embedded_texture(tmp_path):
    path = tmp_path / "square.glb"
    more = {"images": [{"bufferView": 3, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1.0, 0.125, 1.0]}
    path.write_bytes(square_glb({"pbrMetallicRoughness": base}, uv=True, extra=[saved("PNG")], **more))
    mesh = load_mesh(path)
    expected = linear(TEXELS) * [0.5, 1.0, 0.125]
    np.testing.assert_allclose(mesh.texture.numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 0, 0), expected[1, 0], atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 1, 2), expected[0, 0], atol=1e-6)
    assert load_mesh(path, materials=False).channels is None


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


def alpha_mask_glb(alpha, sampler=None, **material):
    """Return the textured square with an alpha in its texture."""
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
    file.write_bytes(alpha_mask_glb(alpha))
    assert load_mesh(file).alpha is None  # opaque
    file.write_bytes(alpha_mask_glb(alpha, alphaMode="MASK"))
    mesh = load_mesh(file)
    assert (mesh.alpha_cutoff, mesh.wrap, mesh.filter) == (0.5, "repeat", "linear")
    np.testing.assert_allclose(mesh.alpha, alpha / 255.0, atol=1e-6)
    np.testing.assert_allclose(texel_at(mesh, 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    assert load_mesh(file, materials=False).alpha is None
    sampler = {"wrapS": 33071, "wrapT": 33648, "magFilter": 9728, "minFilter": 9987}
    base = {"baseColorFactor": [1.0, 0.5, 1.0, 0.75]}
    file.write_bytes(alpha_mask_glb(alpha, sampler, base=base, alphaMode="MASK", alphaCutoff=0.3))
    mesh = load_mesh(file)
    assert (mesh.alpha_cutoff, mesh.wrap, mesh.filter) == (0.3, ("clamp", "mirror"), "nearest")
    np.testing.assert_allclose(mesh.alpha, 0.75 * alpha / 255.0, atol=1e-6)
    # One texel of four is there, and a ray through another meets nothing.
    camera = eg.Camera.look_at([0.5, 0.5, 2.0], [0.5, 0.5, 0.0], size=(8, 8), fov_y=20.0)
    seen = eg.render_aovs(mesh, camera, ["alpha"], 16, seed=0)["alpha"]
    assert 0.0 < seen.mean() < 1.0
    del sampler["wrapS"], sampler["magFilter"]
    file.write_bytes(alpha_mask_glb(alpha, sampler, alphaMode="MASK"))
    assert (load_mesh(file).wrap, load_mesh(file).filter) == (("repeat", "mirror"), "linear")
    file.write_bytes(alpha_mask_glb(alpha, {"wrapS": 1}))
    with pytest.raises(ValueError, match=r"expected a sampler of glTF 2\.0 for the texture .* got wraps \[1, 10497\]"):
        load_mesh(file)


def test_gltf_masks_without_alpha_in_a_texture(tmp_path):
    file = tmp_path / "s.glb"
    for opacity, shows in ((0.7, True), (0.2, False)):
        for uv in (True, False):
            base = {"baseColorFactor": [1.0, 1.0, 1.0, opacity]}
            file.write_bytes(square_glb(material={"pbrMetallicRoughness": base, "alphaMode": "MASK"}, uv=uv))
            camera = eg.Camera.look_at([0.5, 0.5, 2.0], [0.5, 0.5, 0.0], size=(8, 8), fov_y=20.0)
            seen = eg.render_aovs(load_mesh(file), camera, ["alpha"], 4, seed=0)["alpha"].mean()
            assert seen == (1.0 if shows else 0.0)


@pytest.mark.parametrize("type_", ["<f4", "<u1", "<u2"])
def test_gltf_masks_by_alpha_of_vertices(tmp_path, type_):
    """Alpha rises from 0 to 1 from left to right. Times 0.8 it exceeds a half right of 5/8."""
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
        seen = eg.render_aovs(mesh.replace(uvs=uvs).to(torch.float64), camera, ["alpha"], 64, seed=0)["alpha"]
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
        assert eg.render_aovs(load_mesh(file), camera, ["alpha"], 4, seed=0)["alpha"].mean() == shown


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


def test_gltf_with_separate_files(tmp_path):
    whole = square_glb(
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        uv=True,
        images=[{"uri": "my%20skin.png"}],
        textures=[{"source": 0}],
    )
    tree = gltf_tree(whole)
    tree["buffers"][0]["uri"] = "data.bin"
    (tmp_path / "s.gltf").write_text(json.dumps(tree))
    with pytest.raises(FileNotFoundError, match=r"s\.gltf: names 'data\.bin'"):
        load_mesh(tmp_path / "s.gltf")
    (tmp_path / "data.bin").write_bytes(whole[-tree["buffers"][0]["byteLength"] :])
    with pytest.raises(FileNotFoundError, match=r"s\.gltf: names 'my%20skin\.png'"):
        load_mesh(tmp_path / "s.gltf")
    Image.fromarray(TEXELS).save(tmp_path / "my skin.png")
    np.testing.assert_allclose(texel_at(load_mesh(tmp_path / "s.gltf"), 0, 0), linear(TEXELS[1, 0]), atol=1e-6)
    tree["images"][0]["uri"] = "../my skin.png"
    (tmp_path / "s.gltf").write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=r"s\.gltf.*'\.\./my skin\.png', outside its folder"):
        load_mesh(tmp_path / "s.gltf")


def test_gltf_vertex_colours_with_a_texture(tmp_path):
    """They are multiplied where they are all equal. Others need a lit mesh, or no texture."""
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1.0, 0.2, 1.0]}
    given = dict(uv=True, extra=[saved("PNG")], textures=[{"source": 0}], images=[{"bufferView": 4}])
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


def test_glb_by_the_name_of_gltf_and_the_other_way_round(tmp_path):
    whole = square_glb()
    (tmp_path / "a.gltf").write_bytes(whole)
    tree = gltf_tree(whole)
    chunk = whole[-tree["buffers"][0]["byteLength"] :]
    tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(chunk).decode()
    (tmp_path / "b.glb").write_text("\n " + json.dumps(tree))
    for name in ("a.gltf", "b.glb"):
        mesh = load_mesh(tmp_path / name)
        assert mesh.verts.tolist() == SQUARE and mesh.faces.tolist() == TRIANGLES


def test_metallic_roughness_is_shown_where_specular_glossiness_is_given_too(tmp_path):
    gloss = {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 1, 0, 1]}}
    base = {"baseColorFactor": [1.0, 0.5, 0.25, 1.0]}
    used = {"extensionsUsed": list(gloss)}
    (tmp_path / "a.glb").write_bytes(square_glb({"extensions": gloss, "pbrMetallicRoughness": base}, **used))
    with pytest.warns(UserWarning, match=r"SpecularGlossiness \(shown in the metallic-roughness material beside it\)"):
        assert load_mesh(tmp_path / "a.glb").face_colors[0].tolist() == [1.0, 0.5, 0.25]
    (tmp_path / "a.glb").write_bytes(square_glb({"extensions": gloss}, **used))
    with pytest.raises(ValueError, match="expected a metallic-roughness material, got specular-glossiness alone"):
        load_mesh(tmp_path / "a.glb")
