"""Hostile files are refused by name: none runs code, reads outside of its folder, or takes memory for what it announces."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from mesh_3mf import bomb, nested, triangle_3mf
from mesh_files import (
    GOOD,
    IMAGES,
    OFF,
    SQUARE,
    TEXTURED,
    TRIANGLES,
    changed,
    check_refused,
    gltf_tree,
    load,
    ply,
    png,
    saved,
    square_glb,
    write,
)
from PIL import EpsImagePlugin

import edgegrad as eg
from edgegrad.files.parts import MESHES

pytestmark = pytest.mark.unsanitized

# -- headers that announce what is not there --------------------------------------------------------------------------


def jpeg_of(width: int, height: int) -> bytes:
    data = saved("JPEG")
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


def tiff_of(size: int) -> bytes:
    data = bytearray(saved("TIFF"))
    (start,) = struct.unpack("<I", data[4:8])
    for entry in range(start + 2, start + 2 + 12 * struct.unpack("<H", data[start : start + 2])[0], 12):
        if struct.unpack("<H", data[entry : entry + 2])[0] in (256, 257, 278):  # width, height, rows in a strip
            data[entry + 2 : entry + 12] = struct.pack("<HII", 4, 1, size)
    return bytes(data)


def exr_of(folder: Path, size: int) -> bytes:
    eg.write_image(folder / "small.exr", torch.rand(4, 4, 3))
    data = (folder / "small.exr").read_bytes()
    for window in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = data.index(window) + len(window) + 4
        data = data[:at] + struct.pack("<4i", 0, 0, size - 1, size - 1) + data[at + 16 :]
    return data


def without_data(tree: dict, count: int) -> None:
    del tree["accessors"][0]["bufferView"]
    tree["accessors"][0]["count"] = count


BINARY = ply(SQUARE, TRIANGLES, binary=True)
TEXT = ply(SQUARE, TRIANGLES)
MANY = b"1000000000"


def huge() -> dict[str, bytes | str]:
    return {
        "a.png": png(100_000, 100_000),
        "b.png": png(2**31 - 1, 2**31 - 1),
        "c.png": png(0, 0),
        "d.png": png(40_000, 40_000, bytes(10_000_000), 1, 0),  # its size in bits would do
        "a.bmp": struct.pack("<2sIHHI", b"BM", 100, 0, 0, 54)
        + struct.pack("<IiiHHIIiiII", 40, 100_000, 100_000, 1, 24, *[0] * 6)
        + bytes(46),
        "a.jpg": jpeg_of(65_500, 65_500),
        "a.tif": tiff_of(100_000),
        "a.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n" + bytes(100),
        "b.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y -5 +X 100000\n" + bytes(100),
        "a.ply": BINARY.replace(b"face 2", b"face " + MANY),
        "b.ply": BINARY.replace(b"face 2", b"face " + MANY).replace(b"vertex 4", b"vertex " + MANY),
        "c.ply": TEXT.replace(b"face 2", b"face " + MANY).replace(b"vertex 4", b"vertex " + MANY),
        "d.ply": TEXT.replace(b"face 2", b"face -2"),
        "e.ply": BINARY.replace(b"list uchar int", b"list uint int"),
        "a.stl": bytes(80) + struct.pack("<I", 10**9) + bytes(50),
        "a.off": OFF.replace("3 1 0", "1000000000 1000000000 0"),
        "a.glb": square_glb()[:12] + struct.pack("<I", 2**32 - 1) + square_glb()[16:],
        "b.glb": changed(lambda tree: tree["accessors"][0].update(count=10**9)),
        "c.glb": changed(lambda tree: without_data(tree, 10**9)),
        "d.glb": changed(lambda tree: without_data(tree, 10**15)),
        "h.glb": changed(lambda tree: (without_data(tree, 2**34), tree["accessors"].append({"count": -(2**34)}))),
        "e.glb": changed(lambda tree: tree["accessors"][0].update(byteOffset=10**9)),
        "f.glb": changed(lambda tree: tree["bufferViews"][0].update(byteOffset=-5)),
        "g.glb": changed(lambda tree: tree["bufferViews"][0].update(byteStride=10**6)),
        "a.gltf": '{"asset": ' + "[" * 200_000 + "]" * 200_000 + "}",
        "a.obj": GOOD + "f 1 2 1000000000\n",
        "b.obj": GOOD + "f 1 2 100000000000000000000000\n",
        "c.obj": GOOD + "f 1 2 -100000000000000000000000\n",
        "a.3mf": bomb(70),
    }


LOAD_ALL = """
import json, pathlib, sys
import torch
import edgegrad as eg
from edgegrad.files.parts import MESHES
import lxml.etree, OpenImageIO, PIL.Image, trimesh.exchange.load

sys.path.insert(0, sys.argv[1])
from mesh_files import load

def peak():
    return int(next(row for row in open("/proc/self/status") if row.startswith("VmHWM")).split()[1])

load(pathlib.Path(sys.argv[2], "ok.obj"))
report = {}
for path in sorted(pathlib.Path(sys.argv[2]).iterdir()):
    before = peak()
    try: load(path); said = ["nothing", ""]
    except Exception as error: said = [type(error).__name__, str(error)]
    report[path.name] = [*said, (peak() - before) / 1000]
print(json.dumps(report))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak memory from /proc")
def test_what_is_only_announced_takes_no_memory(tmp_path):
    harmful = {**huge(), "z.exr": exr_of(tmp_path, 100_000), "ok.obj": GOOD}
    for name, content in harmful.items():
        write(tmp_path, name, content)
    command = [sys.executable, "-c", LOAD_ALL, str(Path(__file__).parents[1] / "support"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads(done.stdout.splitlines()[-1])
    assert len(report) == len(harmful) + 1
    for name, (error, message, megabytes) in report.items():
        if name in ("ok.obj", "small.exr"):
            assert error == "nothing", message
            continue
        assert error == "ValueError" and message.startswith(str(tmp_path / name)), (name, error, message)
        assert "expected" in message and "got" in message, message
        assert megabytes < 60, (name, megabytes)


def test_an_image_too_large_to_hold_is_refused_by_its_header(tmp_path, monkeypatch):
    """The file may be whole and small: 3 MB of zeros unpack to ten times 2³⁰ numbers."""
    monkeypatch.setattr("edgegrad.files.image.MOST_NUMBERS", 1000)
    path = write(tmp_path, "a.png", png(40, 26, bytes(26 * (1 + 40)), 8, 0))
    with pytest.raises(ValueError, match=r"a\.png: expected at most 1000 pixels times channels, got 26 × 40 × 1"):
        eg.read_image(path)
    assert eg.read_image(write(tmp_path, "b.png", png(40, 25, bytes(25 * 41), 8, 0))).shape == (25, 40, 1)


# -- paths that lead out ----------------------------------------------------------------------------------------------

OUTSIDE = [
    "../secret.png",
    "/etc/passwd",
    "..\\secret.png",
    "%2e%2e/secret.png",
    "sub/../../secret.png",
    "file:///etc/passwd",
    "http://127.0.0.1:9/secret.png",
    "C:\\secret.png",
    "\\\\host\\share\\secret.png",
    "~/secret.png",
    "link.png",
]
NAMING: dict[str, Callable[[str], dict[str, bytes | str]]] = {
    "mtllib": lambda name: {"a.obj": f"mtllib {name}\n{GOOD}"},
    "map_Kd": lambda name: {
        "a.obj": f"mtllib a.mtl\nvt 0 0\nusemtl a\n{GOOD.replace('f 1 2 3', 'f 1/1 2/1 3/1')}",
        "a.mtl": f"newmtl a\nmap_Kd {name}\n",
    },
    "ply": lambda name: {"a.ply": ply(SQUARE, TRIANGLES, comment=f"comment TextureFile {name}\n")},
    "image": lambda name: {
        "a.glb": square_glb(TEXTURED, uv=True, textures=[{"source": 0}], images=[{"uri": name}]),
    },
    "buffer": lambda name: {"a.gltf": json.dumps({**gltf_tree(square_glb()), "buffers": [{"uri": name, "byteLength": 8}]})},
}  # fmt: skip


@pytest.mark.parametrize("kind", NAMING)
def test_nothing_outside_the_folder_is_read(tmp_path, monkeypatch, kind):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.png").write_bytes(saved("PNG"))
    os.symlink(tmp_path / "secret.png", inside / "link.png")
    read = Path.read_bytes
    opened: list[str] = []
    monkeypatch.setattr(Path, "read_bytes", lambda self: opened.append(str(self.resolve())) or read(self))
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("reached for the network"))
    for name in OUTSIDE:
        opened.clear()
        files = [write(inside, file, content) for file, content in NAMING[kind](name).items()]
        with pytest.raises((ValueError, FileNotFoundError), match=r"outside its folder|no such file in") as caught:
            load(files[0])
        assert str(files[0]) in str(caught.value) and "names" in str(caught.value)
        assert opened and all(Path(path).is_relative_to(inside) for path in opened), name


def test_files_below_the_folder_and_in_the_uri_are_read(tmp_path):
    """The test above cannot pass by reading nothing."""
    (tmp_path / "sub").mkdir()
    write(tmp_path, "sub/skin one.png", saved("PNG"))
    material = {"images": [{"uri": "sub/skin%20one.png"}], "textures": [{"source": 0}]}
    mesh = eg.load_mesh(write(tmp_path, "a.glb", square_glb(TEXTURED, uv=True, **material)))
    assert mesh.texture is not None and mesh.texture.shape == (2, 2, 3)


# -- files that would run something -----------------------------------------------------------------------------------


class Touch:
    """An object that makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("form", ["pickle", "torch", "npy", "npz"])
def test_no_pickle_is_opened(tmp_path, form):
    evil, stream = Touch(tmp_path / "ran"), io.BytesIO()
    if form == "pickle":
        pickle.dump(evil, stream)
    elif form == "torch":
        torch.save(evil, stream)
    elif form == "npy":
        np.save(stream, np.array([evil], dtype=object), allow_pickle=True)
    else:
        np.savez(stream, a=np.array([evil], dtype=object))
    for suffix in (*MESHES, *IMAGES, ".json"):
        check_refused(write(tmp_path, "a" + suffix, stream.getvalue()), "expected|codec|Expecting", load)
        assert not (tmp_path / "ran").exists()
    pickle.loads(pickle.dumps(evil))
    assert (tmp_path / "ran").exists()  # it would have


@pytest.mark.parametrize(
    ("kind", "gloss"), [("obj", False), ("ply", False), ("glb", False), ("gltf", False), ("glb", True), ("gltf", True)]
)
def test_postscript_is_no_texture(tmp_path, monkeypatch, kind, gloss):
    """Pillow would start Ghostscript for it, whatever the file is called."""
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("ran Ghostscript"))
    write(tmp_path, "skin.png", saved("EPS"))
    material: dict = dict(TEXTURED)
    if gloss:
        texture = {"diffuseTexture": {"index": 0}, "specularGlossinessTexture": {"index": 0}}
        material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": texture}
    content = square_glb(material, uv=True, textures=[{"source": 0}], images=[{"uri": "skin.png"}])
    uvs = "property float s\nproperty float t\nelement face"
    files: dict[str, bytes | str] = {
        "obj": NAMING["map_Kd"]("skin.png")["a.obj"],
        "ply": TEXT.decode()
        .replace("element face", uvs, 1)
        .replace("ply\nformat ascii 1.0\n", "ply\nformat ascii 1.0\ncomment TextureFile skin.png\n")
        .replace("\n0 0 0\n", "\n0 0 0 0 0\n").replace("\n1 0 0\n", "\n1 0 0 1 0\n").replace("\n1 1 0\n", "\n1 1 0 1 1\n")
        .replace("\n0 1 0\n", "\n0 1 0 0 1\n"),
        "glb": content,
        "gltf": json.dumps({**gltf_tree(content), "buffers": [{"uri": "a.bin", "byteLength": len(content)}]}),
    }  # fmt: skip
    write(tmp_path, "a.mtl", "newmtl a\nmap_Kd skin.png\n")
    write(tmp_path, "a.bin", content[28 + struct.unpack("<I", content[12:16])[0] :])
    path = write(tmp_path, f"a.{kind}", files[kind])
    with pytest.raises(ValueError, match="got EPS|specular-glossiness" if gloss else "got EPS"):
        eg.load_scene(path)
    write(tmp_path, "skin.png", saved("PNG"))
    if not gloss:
        assert eg.load_scene(path).meshes[0].texture is not None


def test_3mf_that_is_unusual_and_harmless(tmp_path):
    """Components contain components, and files have any name. None is written anywhere."""
    path = write(tmp_path, "a.3mf", triangle_3mf(nested(2), {"../../evil.txt": "x", "/tmp/evil.txt": "x"}))
    depths = sorted(mesh.verts[0, 2].item() for mesh in eg.load_scene(path).meshes)
    assert depths == [0.0, 4.0, 8.0, 12.0]
    assert [file.name for file in tmp_path.iterdir()] == ["a.3mf"] and not (tmp_path.parent / "evil.txt").exists()


# -- glTF nodes -------------------------------------------------------------------------------------------------------


def test_deeply_nested_nodes_keep_their_places(tmp_path):
    """Each node is moved by one along x. It took two minutes while the path to each was searched anew."""
    deep = 3000
    nodes = [{"mesh": 0, "children": [i + 1], "translation": [1, 0, 0]} for i in range(deep - 1)]
    content = square_glb(nodes=[*nodes, {"mesh": 0, "translation": [1, 0, 0]}], scenes=[{"nodes": [0]}])
    places = [mesh.verts[0, 0].item() for mesh in eg.load_scene(write(tmp_path, "a.glb", content)).meshes]
    assert sorted(places) == list(range(1, deep + 1))


# -- what else stands in a folder -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".3mf", ".png", ".exr", ".json"])
def test_what_is_no_file(tmp_path, suffix):
    folder, empty, pipe, gone = (tmp_path / f"{name}{suffix}" for name in ("folder", "empty", "pipe", "gone"))
    folder.mkdir()
    empty.touch()
    os.symlink(tmp_path / "nowhere", gone)
    with pytest.raises(ValueError, match=rf"folder\{suffix}: expected a file, got a directory"):
        load(folder)
    with pytest.raises(ValueError, match=rf"empty\{suffix}: expected data, got an empty file"):
        load(empty)
    with pytest.raises(FileNotFoundError, match=rf"gone\{suffix}: expected a file"):
        load(gone)
    if hasattr(os, "mkfifo"):
        os.mkfifo(pipe)
        with pytest.raises(ValueError, match=rf"pipe\{suffix}: expected a file, got a pipe"):
            load(pipe)


def test_without_the_permission_to_read(tmp_path, monkeypatch):
    for suffix in (".obj", ".png", ".json"):
        path = write(tmp_path, "a" + suffix, "x")
        path.chmod(0)
        if os.access(path, os.R_OK):  # the superuser may read everything
            monkeypatch.setattr(os, "access", lambda *_: False)
        with pytest.raises(PermissionError, match=rf"a\{suffix}: expected a file that may be read"):
            load(path)
