"""Files of meshes and images that tests write, byte by byte."""

import io
import json
import struct
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

import edgegrad as eg

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
TRIANGLES = [[0, 1, 2], [0, 2, 3]]
TEXELS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [128, 64, 32]]], np.uint8)  # row 0 on top


def linear(value):
    """Return linear values by the definition in IEC 61966-2-1, in float64."""
    s = np.asarray(value, np.float64) / 255.0
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def texel_at(mesh, face, corner):
    """Return the texel of a small texture in whose cell a corner's texture coordinate lies, with v upwards."""
    u, v = mesh.uvs[mesh.uv_faces[face, corner]].tolist()
    h, w, _ = mesh.texture.shape
    return mesh.texture[int((1.0 - v) * h), int(u * w)].numpy()


IMAGES = (".png", ".jpg", ".bmp", ".tif", ".hdr", ".exr")


def load(path):
    """Call the function that a user would call."""
    if path.suffix in IMAGES:
        return eg.read_image(path)
    return eg.load_camera(path) if path.suffix == ".json" else eg.load_scene(path)


def quietly(path, **options):
    """Return the mesh of a file that causes no warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return eg.load_mesh(path, **options)


def write(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def check_refused(path, fault, *loaders):
    """Check that loaders, by default those of meshes and of scenes, refuse a file by an error that begins with its path."""
    for function in loaders or (eg.load_mesh, eg.load_scene):
        with pytest.raises((ValueError, FileNotFoundError), match=fault) as caught:
            function(path)
        assert str(caught.value).startswith(str(path))


TEXTURED = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}


def write_obj(folder, name="quad.obj", mtl="newmtl skin\nmap_Kd skin.png\n", body=None):
    """Write a square of two triangles whose corners lie in the middles of the four texels, with indices of their
    own."""
    Image.fromarray(TEXELS).save(folder / "skin.png")
    (folder / "quad.mtl").write_text(mtl)
    body = body or (
        "mtllib quad.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        "vt 0.25 0.75\nvt 0.25 0.25\nvt 0.75 0.25\nvt 0.75 0.75\nusemtl skin\nf 1/2 2/3 3/4\nf 1/2 3/4 4/1\n"
    )
    (folder / name).write_text(body)
    return folder / name


def glb(tree, *arrays):
    """Return a GLB file whose accessors and buffer views follow from the arrays; bytes become buffer views only."""
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
    """Return the square as a GLB file, with attributes and nodes as a test needs them."""
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


def gltf_tree(data):
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


def changed(change, data=None):
    """Return a GLB file, by default the square, with its JSON changed."""
    data = square_glb() if data is None else data
    tree = gltf_tree(data)
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + struct.unpack("<I", data[12:16])[0] :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def png(width, height, rows=bytes(100), depth=8, color=2):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def saved(kind, image=None):
    stream = io.BytesIO()
    (Image.fromarray(TEXELS) if image is None else image).save(stream, kind)
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


GOOD = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
)


def ply_header(vertex="", face="property list uchar int vertex_indices\n", more=""):
    """Return the header of a text PLY of three vertices and a face, with more properties and elements."""
    return (
        f"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{vertex}"
        f"element face 1\n{face}{more}end_header\n"
    )


CORNERS = [[SQUARE[i] for i in face] for face in TRIANGLES]


def binary_stl(attribute=0, name=b"x"):
    """Return the square as a binary STL."""
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *np.ravel(face), attribute) for face in CORNERS)
    return name.ljust(80, b"\0") + struct.pack("<I", len(CORNERS)) + body
