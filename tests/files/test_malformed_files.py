"""Malformed files are refused with an error that names the file and the bad value, or load as they should."""

import base64
import gzip
import json
import math
import struct

import numpy as np
import pytest
import torch
from lit_gltf import CORNERS, TURN, file, places
from mesh_3mf import DOCTYPE_BOMB, PRODUCTION, bomb, chain, model, nested
from mesh_files import (
    GOOD,
    OFF,
    SQUARE,
    STL,
    TEXELS,
    TEXTURED,
    TRIANGLES,
    changed,
    glb,
    gltf_tree,
    load,
    ply,
    saved,
    square_glb,
    write,
    write_obj,
)
from PIL import Image

import edgegrad as eg
from edgegrad.files.load import load_mesh, load_scene


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("a.xyz", "1 2 3", "ends in .obj, .gltf"),
        ("a.pkl", b"\x80\x04N.", "ends in .obj, .gltf"),
        ("a", GOOD, "'no ending'"),
        ("a.obj", "# nothing\n", "expected triangles, got none"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "expected triangles, got none"),
        ("a.obj", GOOD + "f 1 2 9\n", r"indices of vertices \(v\) from 1 to 3, got 9"),
        ("a.obj", GOOD + "f 0 1 2\n", "count from 1, got 0"),
        ("a.obj", GOOD + "f 1 2 -7\n", r"indices of vertices \(v\) from 1 to 3, got -3"),
        ("a.obj", GOOD + "f 1 x 3\nf 1 2 3\n", "numbers alone in the faces, got 'x'"),
        ("a.obj", GOOD.replace("f 1 2 3", "f 1 2"), "expected triangles, got none"),
        ("a.ply", ply(SQUARE, [[0, 1]]), "expected triangles, got none"),
        (
            "a.ply",
            ply(SQUARE, [[0, 1, 2]]).replace(b"uchar int", b"uchar float").replace(b"3 0 1 2", b"3 0 1.5 2"),
            "whole numbers for vertex_indices in face, got 1.5",
        ),
        ("a.stl", "o part\n" + GOOD, "expected an STL file, got text without solid or facet at its start"),
        (
            "a.obj",
            "version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 1\n",
            "a pointer of git-lfs .* git lfs pull",
        ),
        (
            "a.glb",
            "version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 1\n",
            "a pointer of git-lfs .* git lfs pull",
        ),
        ("a.stl", "<!DOCTYPE html><html>404</html>", "a page of the web"),
        ("a.ply", "\n <HTML>404</HTML>", "a page of the web"),
        ("a.off", gzip.compress(OFF.encode(), mtime=0), "data compressed by gzip; unpack"),
        ("a.gltf", b"PK\x03\x04" + bytes(30), "an archive of zip; unpack"),
        ("a.obj", GOOD.replace("v 0 1 0", "v 0 nan 0"), "finite positions.* at vertex 2"),
        ("a.obj", GOOD.replace("v 0 1 0", "v 0 1e99 0"), "finite positions.* at vertex 2"),
        ("a.obj", "v 0 0 0 0 0 0\nv 1 0 0 0 nan 0\nv 0 1 0 1 1 1\nf 1 2 3\n", "vertex colours.*nan.* at vertex 1"),
        ("a.obj", "v 0 0 0 0 0 0\nv 1 0 0 0 -1 0\nv 0 1 0 1 1 1\nf 1 2 3\n", "vertex colours.*-1.* at vertex 1"),
        ("a.off", OFF.replace("3 0 1 2", "3 0 1 5"), "vertex indices from 0 to 2, got 5"),
        ("a.off", OFF.replace("3 1 0", "3 2 0"), "the 2 faces that the file announces, got 1"),
        ("a.off", OFF[:20], "cannot be read"),
        ("a.off", "hello", "cannot be read"),
        ("a.stl", STL[:60], "expected endsolid"),
        ("a.stl", STL + STL[:-9], "expected endsolid"),
        ("a.stl", b"\0" * 80 + struct.pack("<I", 3) + b"\0" * 60, "the 3 faces that the file announces, got 1;"),
        ("a.stl", STL.replace("vertex 0 1 0", "vertex 0 inf 0"), "finite positions"),
        ("a.ply", ply(SQUARE, []), "expected triangles, got none"),
        ("a.ply", ply(SQUARE, TRIANGLES)[:-10], "truncated"),
        ("a.ply", ply(SQUARE, TRIANGLES)[:-20], "truncated"),
        ("a.ply", ply(SQUARE, TRIANGLES, binary=True)[:-4], "cannot be read"),
        ("a.ply", ply(SQUARE, TRIANGLES)[:60], "cannot be read"),
        ("a.ply", ply(SQUARE, [[0, 1, 4]]), "indices from 0 to 3, got 4"),
        ("a.ply", ply(SQUARE, [[0, 1, -1]], binary=True), "indices from 0 to 3, got -1"),
        ("a.ply", ply([[0, 0, 0], [1, 0, 0], [0, float("nan"), 0]], [[0, 1, 2]], binary=True), "finite positions"),
        ("a.glb", b"glTF", "something else"),
        ("a.glb", square_glb()[:60], "cannot be read"),
        ("a.glb", square_glb()[:-8], "cannot be read"),
        ("a.glb", square_glb(scenes=[{"nodes": []}]), "expected triangles, got none"),
        ("a.glb", square_glb(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        ("a.glb", square_glb(meshes=5), "expected an array at meshes, got 5"),
        (
            "a.glb",
            square_glb(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}]),
            "three indices a tri",
        ),
        ("a.glb", square_glb(nodes=[{"mesh": 0, "children": [0]}]), "a tree of nodes"),
        ("a.glb", square_glb(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]), "a tree of nodes"),
        ("a.glb", square_glb(nodes=[{"children": [2]}, {"children": [2]}, {"mesh": 0}]), "a tree of nodes"),
        ("a.gltf", "{", "cannot be read"),
        ("a.gltf", "[]", "JSON object"),
        ("a.3mf", b"PK\x03\x04 not a zip", "cannot be read"),
    ],
)
def test_faults_are_named(tmp_path, name, content, fault):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for function in (load_mesh, load_scene):
        with pytest.raises(ValueError, match=fault) as caught:
            function(path)
        assert str(caught.value).startswith(str(path))


def test_paths_that_are_no_file_names(tmp_path):
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
    path = write_obj(tmp_path, body="mtllib quad.mtl\nusemtl skin\n" + GOOD)
    with pytest.raises(ValueError, match=r"quad\.obj.*expected texture coordinates"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("statements", "fault"),
    [
        ("Kd 1 x 0", "expected numbers for kd in the material, got '1 x 0'"),
        ("Kd -1 0 0", "expected numbers from 0 on for Kd in the material, got '-1 0 0'"),
        (
            "map_Kd -foo 1 skin.png",
            r"expected options of a texture \(-blendu, .*\), got -foo in map_Kd '-foo 1 skin\.png'",
        ),
    ],
)
def test_faults_of_a_material_name_it_and_its_file(tmp_path, statements, fault):
    path = write_obj(tmp_path, mtl=f"newmtl other\nKd 1 1 1\nnewmtl skin\n{statements}\n")
    with pytest.raises(ValueError, match=rf"quad\.obj: newmtl skin in quad\.mtl: {fault}"):
        load_mesh(path)


def test_a_texture_that_is_a_pointer_of_git_lfs(tmp_path):
    path = write_obj(tmp_path)
    (tmp_path / "skin.png").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 1\n")
    with pytest.raises(ValueError, match=r"image in the texture 'skin\.png', got a pointer of git-lfs"):
        load_mesh(path)


def without(*place):
    def change(tree):
        *way, last = place
        for step in way:
            tree = tree[step]
        del tree[last]

    return change


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (without("accessors", 0, "count"), r"expected integer at accessors\[0\]\.count, got none"),
        (without("accessors", 1, "componentType"), r"expected .* at accessors\[1\]\.componentType, got none"),
        (without("meshes", 0, "primitives"), r"expected array at meshes\[0\]\.primitives, got none"),
        (without("meshes", 0, "primitives", 0, "attributes"), r"at meshes\[0\]\.primitives\[0\]\.attributes, got none"),
        (without("bufferViews", 0, "byteLength"), r"expected integer at bufferViews\[0\]\.byteLength, got none"),
        (lambda tree: tree["nodes"].__setitem__(0, [1]), r"expected an object at nodes\[0\], got \[1\]"),
        (lambda tree: tree["nodes"][0].update(mesh=[0]), r"expected an integer at nodes\[0\]\.mesh, got \[0\]"),
        (
            lambda tree: tree["bufferViews"][0].update(byteOffset=40),
            r"bytes 40 to 88 of buffer 0 for bufferViews\[0\], got 60 bytes",
        ),
        (
            lambda tree: tree["bufferViews"][0].update(byteStride=8),
            "a byteStride of 12 or more for rows of 12 bytes, got 8",
        ),
        (
            lambda tree: tree["accessors"][0].update(count=5),
            r"5 rows of 3 × float32 from byte 0 to 60 of bufferViews\[0\], got 48 bytes",
        ),
        (lambda tree: tree["buffers"][0].update(uri="x.bin"), r"names 'x\.bin', and .* put it there$"),
    ],
)
def test_gltf_faults_name_their_place_in_the_json(tmp_path, change, fault):
    (tmp_path / "a.glb").write_bytes(changed(change, square_glb()))
    with pytest.raises((ValueError, FileNotFoundError), match=rf"a\.glb: .*{fault}") as caught:
        load_mesh(tmp_path / "a.glb")
    assert "Error:" not in str(caught.value)


def test_a_gltf_whose_buffer_is_nowhere(tmp_path):
    (tmp_path / "a.gltf").write_text(json.dumps(gltf_tree(square_glb())))
    with pytest.raises(
        ValueError, match="expected the data of buffer 0 by a uri, got none; export it again, or as GLB"
    ):
        load_mesh(tmp_path / "a.gltf")


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


def test_the_material_beside_specular_glossiness_is_shown(tmp_path):
    gloss = {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 1, 0, 1]}}
    base = {"baseColorFactor": [1.0, 0.5, 0.25, 1.0]}
    used = {"extensionsUsed": list(gloss)}
    (tmp_path / "a.glb").write_bytes(square_glb({"extensions": gloss, "pbrMetallicRoughness": base}, **used))
    with pytest.warns(UserWarning, match=r"SpecularGlossiness \(shown in the metallic-roughness material beside it\)"):
        assert load_mesh(tmp_path / "a.glb").face_colors[0].tolist() == [1.0, 0.5, 0.25]
    (tmp_path / "a.glb").write_bytes(square_glb({"extensions": gloss}, **used))
    with pytest.raises(ValueError, match="expected a metallic-roughness material, got specular-glossiness alone"):
        load_mesh(tmp_path / "a.glb")


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
    options = {"uv": True, "extra": [saved("PNG")], "textures": [{"source": 0}], **change}
    base = {"baseColorTexture": options.pop("reference", {"index": 0})}
    view = 2 + bool(options["uv"]) + ("colors" in options)
    options.setdefault("images", [{"bufferView": view}])
    (tmp_path / "t.glb").write_bytes(square_glb({"pbrMetallicRoughness": base}, **options))
    with pytest.raises((ValueError, FileNotFoundError), match=rf"t\.glb.*{fault}"):
        load_mesh(tmp_path / "t.glb")


# -- 3MF ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content, fault",
    [
        (model({"<model": f'<!DOCTYPE a [<!ENTITY l0 "0">{DOCTYPE_BOMB}]><model', 'x="0"': 'x="&l9;"'}), "without a DOCTYPE"),
        (model({"<model": '<!DOCTYPE a [<!ENTITY s SYSTEM "file:///etc/passwd">]><model'}), "without a DOCTYPE"),
        (model({"<model": '<!DOCTYPE a SYSTEM "http://127.0.0.1:9/a.dtd"><model'}), "without a DOCTYPE"),
        (
            model(
                {'item objectid="1"': f'item objectid="1" xmlns:p="{PRODUCTION}" p:path="/3D/other.model"'},
                {"3D/other.model": '<!DOCTYPE a SYSTEM "a.dtd"><model/>'},
            ),
            r"in '3d/other\.model'",
        ),
        (model(nested(38)), "at most 100000 instances of objects, got 274877906944"),
        (model(chain(100)), "nested up to 64 times, got more"),
        (
            model({"</resources>": '<object id="2"><components><component objectid="2"/></components></object></resources>',
                   'item objectid="1"': 'item objectid="2"'}),
            "object 2 inside itself",
        ),
        (model({'item objectid="1"': 'item objectid="7"'}), "an object with the id 7 in '3d/3dmodel.model', got none"),
        (model({'<vertex x="1"': '<vertex w="1"'}), "the attributes x, y and z of each vertex of object 1, got one without 'x'"),
        (model({'<vertex x="1"': '<vertex x="1,5"'}), "numbers alone in x, y and z of each vertex of object 1, got '1,5'"),
        (model({'v3="2"': 'v3="9"'}), "indices from 0 to 2, got 9"),
        (model({"</build>": ""}), "cannot be read"),
        (model()[:-30], "cannot be read"),
        (bomb(70), "an archive that grows up to 100 times"),
    ],
)  # fmt: skip
def test_3mf_faults(tmp_path, content, fault):
    path = write(tmp_path, "a.3mf", content)
    with pytest.raises(ValueError, match=fault) as caught:
        eg.load_scene(path)
    assert str(caught.value).startswith(str(path)) and len(content) < 200_000


# -- every byte counts ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.glb", "a.ply", "b.ply", "a.3mf", "a.stl", "a.off", "a.png", "a.bmp", "a.exr"])
def test_cut_anywhere(tmp_path, name):
    """Every beginning of a good file is an error that names it, or loads as the whole does."""
    eg.write_image(tmp_path / "whole.exr", torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(1)))
    material = {"images": [{"bufferView": 3}], "textures": [{"source": 0}], "extra": [saved("PNG")]}
    stl = STL.replace("endsolid a", STL[8:])
    whole = {
        "a.glb": square_glb(TEXTURED, uv=True, **material),
        "a.ply": ply(SQUARE, TRIANGLES, binary=True),
        "b.ply": ply(SQUARE, TRIANGLES),
        "a.3mf": model(),
        "a.stl": stl.encode(),
        "a.off": OFF.encode(),
        "a.png": saved("PNG"),
        "a.bmp": saved("BMP"),
        "a.exr": (tmp_path / "whole.exr").read_bytes(),
    }[name]
    expected = load(write(tmp_path, name, whole))
    for end in range(1, len(whole), max(1, len(whole) // 70)):
        try:
            found = load(write(tmp_path, name, whole[:end]))
        except ValueError as error:
            assert str(error).startswith(str(tmp_path / name))
            continue
        if isinstance(expected, torch.Tensor):
            assert torch.equal(found, expected), end
        else:
            assert repr(found) == repr(expected), end
            for mesh, other in zip(found.meshes, expected.meshes, strict=True):
                assert torch.equal(mesh.verts, other.verts) or (name, end) == ("a.off", len(whole) - 1), end


@pytest.mark.parametrize("seed", range(3))
def test_bytes_changed_at_random(tmp_path, seed):
    """A changed file loads or is refused; the names of the errors are all that a caller must know."""
    material = {"images": [{"bufferView": 3}], "textures": [{"source": 0}], "extra": [saved("PNG")]}
    names = {
        "a.glb": square_glb(TEXTURED, uv=True, **material),
        "a.ply": ply(SQUARE, TRIANGLES, [[1, 2, 3]] * 4, binary=True),
        "b.ply": ply(SQUARE, TRIANGLES),
        "a.obj": GOOD.encode() * 2,
        "a.stl": STL.encode(),
        "a.3mf": model(),
        "a.png": saved("PNG"),
        "a.jpg": saved("JPEG"),
        "a.tif": saved("TIFF"),
        "a.bmp": saved("BMP"),
    }
    random = np.random.default_rng(seed)
    refused = 0
    for name, whole in names.items():
        for _ in range(25):
            content = bytearray(whole)
            for at in random.integers(0, len(content), random.integers(1, 6)):
                content[at] = random.integers(0, 256)
            path = write(tmp_path, name, bytes(content))
            try:
                load(path)
            except (ValueError, FileNotFoundError) as error:
                assert str(path) in str(error)
                refused += 1
    assert 30 < refused < 250


# -- one wrong value in a glTF ------------------------------------------------------------------------------------------

JUNK = (
    None,
    -1,
    0,
    3,
    10**9,
    1.5,
    math.nan,
    math.inf,
    1e300,
    "",
    "KHR",
    [],
    [1],
    [1, 2, 3, 4, 5],
    {},
    {"index": 0},
    True,
)


def whole_file(folder):
    """Something of everything."""
    transform = {"KHR_texture_transform": {"offset": [0, 1], "rotation": 1.0, "scale": [1, 2], "texCoord": 1}}
    given = {
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 1], "metallicRoughnessTexture": {"index": 0},
            "metallicFactor": 0.5, "roughnessFactor": 0.5,
        },
        "emissiveTexture": {"index": 0, "extensions": transform}, "emissiveFactor": [1, 1, 1],
        "normalTexture": {"index": 0, "scale": 1.0}, "occlusionTexture": {"index": 0}, "alphaMode": "BLEND", "doubleSided": True,
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2.0}, "KHR_materials_sheen": {}},
    }  # fmt: skip
    light = {"extensions": {"KHR_lights_punctual": {"light": 0}}, "rotation": TURN, "scale": [1, 1, 1]}
    return file(
        folder, given, [TEXELS], nodes=[{"mesh": 0, "children": [1]}, light], roots=[0], uvs=(CORNERS, CORNERS),
        attributes={"NORMAL": np.array([[0, 0, 1]] * 4, "<f4"), "COLOR_0": np.ones((4, 4), "<f4")},
        lights=[{"type": "spot", "color": [1, 1, 1], "range": 1.0, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5}}],
        samplers=[{"wrapS": 33071, "minFilter": 9987}], extensionsUsed=["KHR_lights_punctual"],
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*not rendered as the file asks")
@pytest.mark.parametrize("count", [120, pytest.param(4000, marks=pytest.mark.slow)])
def test_files_with_one_wrong_value_load_or_are_refused_by_name(tmp_path, count):
    path = whole_file(tmp_path)
    whole, random = path.read_bytes(), np.random.default_rng(1)
    eg.load_scene(path, lit=True)
    refused = 0
    for _ in range(count):

        def replace_one_value(tree):
            found = list(places(tree))
            holder, key = found[random.integers(len(found))]
            holder[key] = JUNK[random.integers(len(JUNK))]

        path.write_bytes(changed(replace_one_value, whole))
        try:
            eg.load_scene(path, lit=True)
        except (ValueError, FileNotFoundError) as error:
            assert str(error).startswith(str(path)), error
            refused += 1
    assert 0.1 * count < refused < 0.9 * count


def test_glb_helper_makes_what_these_tests_change():
    """So that a refused file is refused for its change."""
    assert changed(lambda tree: None)[:12] == square_glb()[:12] and glb({})[:4] == b"glTF"
