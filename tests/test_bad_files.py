"""Files made to do harm: they are refused with an error that names them, or load as they should; none runs code, reads what
lies outside its folder, hangs, or takes memory for what it merely announces."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from mesh_files import GOOD, OFF, SQUARE, STL, TEXELS, TRIANGLES, glb, linear, ply, square_glb
from PIL import EpsImagePlugin, Image

import edgegrad as eg
from edgegrad.files.parts import MESHES

IMAGES = (".png", ".jpg", ".bmp", ".tif", ".hdr", ".exr")


def load(path: Path) -> object:
    """What a user would call."""
    if path.suffix in IMAGES:
        return eg.read_image(path)
    return eg.load_camera(path) if path.suffix == ".json" else eg.load_scene(path)


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def gltf_tree(data: bytes) -> dict:
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


def changed(change: Callable[[dict], object], data: bytes | None = None) -> bytes:
    """A GLB file, by default the square, with its JSON changed."""
    data = square_glb() if data is None else data
    tree = gltf_tree(data)
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + struct.unpack("<I", data[12:16])[0] :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def png(width: int, height: int, rows: bytes = bytes(100), depth: int = 8, color: int = 2) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def saved(kind: str, image: Image.Image | None = None) -> bytes:
    stream = io.BytesIO()
    (Image.fromarray(TEXELS) if image is None else image).save(stream, kind)
    return stream.getvalue()


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


@cache
def bomb(megabytes: int) -> bytes:
    """A 3MF of a few kilobytes that holds so many spaces."""
    head, tail = MODEL.split("</resources>")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("3D/3dmodel.model", "w") as model:
        model.write(head.encode())
        for _ in range(megabytes):
            model.write(b" " * 2**20)
        model.write(b"</resources>" + tail.encode())
    return stream.getvalue()


MODEL = (
    '<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
    '<object id="1" type="model"><mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>'
    '<vertex x="0" y="1" z="0"/></vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>'
    '</resources><build><item objectid="1"/></build></model>'
)
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
from test_bad_files import load

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
    command = [sys.executable, "-c", LOAD_ALL, str(Path(__file__).parent), str(tmp_path)]
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
    """A whole file, and a small one: 3 MB of zeros unpack to ten times 2³⁰ numbers."""
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
TEXTURED = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
WAYS: dict[str, Callable[[str], dict[str, bytes | str]]] = {
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


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("way", WAYS)
def test_nothing_outside_the_folder_is_read(tmp_path, monkeypatch, way, name):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.png").write_bytes(saved("PNG"))
    os.symlink(tmp_path / "secret.png", inside / "link.png")
    files = [write(inside, file, content) for file, content in WAYS[way](name).items()]
    opened: list[str] = []
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: opened.append(str(self.resolve())) or read(self))
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("reached for the network"))
    with pytest.raises((ValueError, FileNotFoundError), match=r"outside its folder|no such file in") as caught:
        load(files[0])
    assert str(files[0]) in str(caught.value) and "names" in str(caught.value)
    assert opened and all(Path(path).is_relative_to(inside) for path in opened)


def test_files_below_the_folder_and_in_the_uri_are_read(tmp_path):
    """What may be read: so that the test above cannot pass by reading nothing."""
    (tmp_path / "sub").mkdir()
    write(tmp_path, "sub/skin one.png", saved("PNG"))
    material = {"images": [{"uri": "sub/skin%20one.png"}], "textures": [{"source": 0}]}
    mesh = eg.load_mesh(write(tmp_path, "a.glb", square_glb(TEXTURED, uv=True, **material)))
    assert mesh.texture is not None and mesh.texture.shape == (2, 2, 3)


# -- files that would run something -----------------------------------------------------------------------------------


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("suffix", [*MESHES, *IMAGES, ".json"])
@pytest.mark.parametrize("form", ["pickle", "torch", "npy", "npz"])
def test_no_pickle_is_opened(tmp_path, suffix, form):
    evil, stream = Touch(tmp_path / "ran"), io.BytesIO()
    if form == "pickle":
        pickle.dump(evil, stream)
    elif form == "torch":
        torch.save(evil, stream)
    elif form == "npy":
        np.save(stream, np.array([evil], dtype=object), allow_pickle=True)
    else:
        np.savez(stream, a=np.array([evil], dtype=object))
    path = write(tmp_path, "a" + suffix, stream.getvalue())
    with pytest.raises(ValueError, match=r"expected|codec|Expecting") as caught:
        load(path)
    assert str(caught.value).startswith(str(path))
    assert not (tmp_path / "ran").exists()
    pickle.loads(pickle.dumps(evil))
    assert (tmp_path / "ran").exists()  # it would have


@pytest.mark.parametrize("gloss", [False, True])
@pytest.mark.parametrize("kind", ["obj", "ply", "glb", "gltf"])
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
        "obj": WAYS["map_Kd"]("skin.png")["a.obj"],
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
    if not (gloss and kind in ("glb", "gltf")):
        assert eg.load_scene(path).meshes[0].texture is not None


def model(changes: dict[str, str] | None = None, extra: dict[str, str] | None = None) -> bytes:
    """A 3MF with its text changed, and with more files."""
    text = MODEL
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {"3D/3dmodel.model": text, **(extra or {})}.items():
            archive.writestr(name, content)
    return stream.getvalue()


def nested(depth: int) -> dict[str, str]:
    """Objects of two components each, the one below: 2^depth triangles."""
    objects = "".join(
        f'<object id="{i}"><components><component objectid="{i - 1}"/>'
        f'<component objectid="{i - 1}" transform="1 0 0 0 1 0 0 0 1 0 0 {2.0**i}"/></components></object>'
        for i in range(2, depth + 2)
    )
    return {"</resources>": objects + "</resources>", 'item objectid="1"': f'item objectid="{depth + 1}"'}


def chain(depth: int) -> dict[str, str]:
    """Objects of one component each, the one below."""
    objects = "".join(
        f'<object id="{i}"><components><component objectid="{i - 1}"/></components></object>'
        for i in range(2, depth + 1)
    )
    return {"</resources>": objects + "</resources>", 'item objectid="1"': f'item objectid="{depth}"'}


PRODUCTION = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"
LOL = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))


@pytest.mark.parametrize(
    "content, fault",
    [
        (model({"<model": f'<!DOCTYPE a [<!ENTITY l0 "0">{LOL}]><model', 'x="0"': 'x="&l9;"'}), "without a DOCTYPE"),
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


def test_3mf_that_looks_odd_and_is_not(tmp_path):
    """Components in components, and files beside the model with any name: none is written anywhere."""
    path = write(tmp_path, "a.3mf", model(nested(2), {"../../evil.txt": "x", "/tmp/evil.txt": "x"}))
    depths = sorted(mesh.verts[0, 2].item() for mesh in eg.load_scene(path).meshes)
    assert depths == [0.0, 4.0, 8.0, 12.0]
    assert [file.name for file in tmp_path.iterdir()] == ["a.3mf"] and not (tmp_path.parent / "evil.txt").exists()


# -- glTF nodes -------------------------------------------------------------------------------------------------------


def test_deeply_nested_nodes_keep_their_places(tmp_path):
    """Each moved by one along x; two minutes, where the way to each is looked for anew."""
    deep = 3000
    nodes = [{"mesh": 0, "children": [i + 1], "translation": [1, 0, 0]} for i in range(deep - 1)]
    content = square_glb(nodes=[*nodes, {"mesh": 0, "translation": [1, 0, 0]}], scenes=[{"nodes": [0]}])
    places = [mesh.verts[0, 0].item() for mesh in eg.load_scene(write(tmp_path, "a.glb", content)).meshes]
    assert sorted(places) == list(range(1, deep + 1))


@pytest.mark.parametrize(
    "nodes",
    [
        [{"mesh": 0, "children": [0]}],
        [{"mesh": 0, "children": [1]}, {"children": [0]}],
        [{"children": [2]}, {"children": [2]}, {"mesh": 0}],
    ],
)
def test_nodes_that_are_no_tree(tmp_path, nodes):
    path = write(tmp_path, "a.glb", square_glb(nodes=nodes))
    with pytest.raises(ValueError, match=r"a\.glb: expected a tree of nodes"):
        eg.load_scene(path)


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


@pytest.mark.parametrize("suffix", [".obj", ".png", ".json"])
def test_without_the_permission_to_read(tmp_path, monkeypatch, suffix):
    path = write(tmp_path, "a" + suffix, "x")
    path.chmod(0)
    if os.access(path, os.R_OK):  # the superuser may read everything
        monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(PermissionError, match=rf"a\{suffix}: expected a file that may be read"):
        load(path)


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
        "b.ply": TEXT,
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


# -- kinds of images that must load -----------------------------------------------------------------------------------

STORED = np.random.default_rng(5).integers(0, 256, (4, 5, 4), dtype=np.uint8)


@pytest.mark.parametrize(
    "mode, channels",
    [("1", 1), ("L", 1), ("LA", 2), ("P", 3), ("RGB", 3), ("RGBA", 4), ("I;16", 1)],
)
def test_modes_of_png_and_tiff(tmp_path, mode, channels):
    """Also as textures, where alpha is dropped."""
    if mode == "I;16":
        image = Image.fromarray(np.random.default_rng(6).integers(0, 65536, (4, 5), dtype=np.uint16))
        values = np.asarray(image)[..., None] / 257.0
    else:
        image = Image.fromarray(STORED).convert("RGB").convert(mode) if mode != "RGBA" else Image.fromarray(STORED)
        if mode == "LA":
            image.putalpha(Image.fromarray(STORED[..., 3]))
        values = np.asarray(image.convert({"P": "RGB", "1": "L"}.get(mode, mode)), np.float64).reshape(4, 5, -1)
    colors = channels - (channels in (2, 4))
    expected = np.concatenate([linear(values[..., :colors]), values[..., colors:] / 255.0], -1)
    for suffix in ("png", "tif"):
        image.save(tmp_path / f"a.{suffix}")
        found = eg.read_image(tmp_path / f"a.{suffix}")
        assert found.shape == (4, 5, channels)
        # Pillow writes the 16-bit palette of a TIFF as 256 times the byte, not 257.
        loose = mode == "P" and suffix == "tif"
        np.testing.assert_allclose(found.numpy(), expected, atol=0.01 if loose else 1e-6)
    material = {"images": [{"bufferView": 3}], "textures": [{"source": 0}], "extra": [saved("PNG", image)]}
    mesh = eg.load_mesh(write(tmp_path, "a.glb", square_glb(TEXTURED, uv=True, **material)))
    np.testing.assert_allclose(mesh.texture.numpy(), np.broadcast_to(expected[..., :colors], (4, 5, 3)), atol=1e-6)


def test_glb_helper_makes_what_these_tests_change():
    """So that a refused file is refused for its change."""
    assert changed(lambda tree: None)[:12] == square_glb()[:12] and glb({})[:4] == b"glTF"
