"""Malformed files are refused with an error that names the file and the bad value."""

import gzip
import json
import struct

import numpy as np
import pytest
from mesh_files import (
    GOOD,
    OFF,
    SQUARE,
    STL,
    TRIANGLES,
    changed,
    check_refused,
    gltf_tree,
    ply,
    saved,
    square_glb,
    write,
    write_obj,
)
from PIL import Image

from edgegrad.files.load import load_mesh

pytestmark = pytest.mark.unsanitized


def without(*place):
    def change(tree):
        *way, last = place
        for step in way:
            tree = tree[step]
        del tree[last]

    return change


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
        ("a.glb", changed(without("accessors", 0, "count")), r"expected integer at accessors\[0\]\.count, got none"),
        (
            "a.glb",
            changed(without("accessors", 1, "componentType")),
            r"expected .* at accessors\[1\]\.componentType, got none",
        ),
        ("a.glb", changed(without("meshes", 0, "primitives")), r"expected array at meshes\[0\]\.primitives, got none"),
        (
            "a.glb",
            changed(without("meshes", 0, "primitives", 0, "attributes")),
            r"at meshes\[0\]\.primitives\[0\]\.attributes, got none",
        ),
        (
            "a.glb",
            changed(without("bufferViews", 0, "byteLength")),
            r"expected integer at bufferViews\[0\]\.byteLength, got none",
        ),
        (
            "a.glb",
            changed(lambda tree: tree["nodes"].__setitem__(0, [1])),
            r"expected an object at nodes\[0\], got \[1\]",
        ),
        (
            "a.glb",
            changed(lambda tree: tree["nodes"][0].update(mesh=[0])),
            r"expected an integer at nodes\[0\]\.mesh, got \[0\]",
        ),
        (
            "a.glb",
            changed(lambda tree: tree["bufferViews"][0].update(byteOffset=40)),
            r"bytes 40 to 88 of buffer 0 for bufferViews\[0\], got 60 bytes",
        ),
        (
            "a.glb",
            changed(lambda tree: tree["bufferViews"][0].update(byteStride=8)),
            "a byteStride of 12 or more for rows of 12 bytes, got 8",
        ),
        (
            "a.glb",
            changed(lambda tree: tree["accessors"][0].update(count=5)),
            r"5 rows of 3 × float32 from byte 0 to 60 of bufferViews\[0\], got 48 bytes",
        ),
        (
            "a.glb",
            changed(lambda tree: tree["buffers"][0].update(uri="x.bin")),
            r"names 'x\.bin', and .* put it there$",
        ),
        (
            "a.gltf",
            json.dumps(gltf_tree(square_glb())),
            "expected the data of buffer 0 by a uri, got none; export it again, or as GLB",
        ),
        ("a.3mf", b"PK\x03\x04 not a zip", "cannot be read"),
    ],
)
def test_malformed_files_are_refused_by_name(tmp_path, name, content, fault):
    check_refused(write(tmp_path, name, content), fault)


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
    (tmp_path / "skin.png").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 1\n")
    with pytest.raises(ValueError, match=r"image in the texture 'skin\.png', got a pointer of git-lfs"):
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
