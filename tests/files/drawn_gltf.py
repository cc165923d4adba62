"""Unusual but valid glTF and GLB files, which hypothesis draws, each with the arrays that it was written from."""

from __future__ import annotations

import base64
import itertools
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from drawn_files import DrawnFile, ExpectedMesh, one_of, placed
from hypothesis import strategies as st

Draw = Callable[[st.SearchStrategy], Any]
COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
NAMES = ("a", "a", "world", "", "ä∆ \\", 'b/"c"')


def rotation(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Return the matrix (3, 3) of a unit quaternion."""
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


class Storage:
    """Buffers, views of them and accessors of a glTF."""

    def __init__(self, random: np.random.Generator, count: int) -> None:
        self.random = random
        self.buffers = [bytearray() for _ in range(count)]
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def view(self, content: bytes, **more: Any) -> int:
        """Add a view of any of the buffers, after bytes that nothing uses."""
        number = int(self.random.integers(len(self.buffers)))
        buffer = self.buffers[number]
        buffer += self.random.bytes(-len(buffer) % 4 + 4 * int(self.random.integers(3)))
        start = {"byteOffset": len(buffer)} if len(buffer) or self.random.random() < 0.5 else {}
        self.views.append({"buffer": number, **start, "byteLength": len(content), **more})
        buffer += content
        return len(self.views) - 1

    def accessor(self, rows: np.ndarray, normalized: bool, **more: Any) -> int:
        kind = "SCALAR" if rows.ndim == 1 else f"VEC{rows.shape[1]}"
        given = {"componentType": COMPONENTS[rows.dtype.str[1:]], "count": len(rows), "type": kind, **more}
        if normalized or self.random.random() < 0.2:
            given["normalized"] = normalized
        self.accessors.append(given)
        return len(self.accessors) - 1

    def indices(self, values: np.ndarray) -> int:
        rows = values.astype(one_of(self.random, "<u1", "<u2", "<u4"))
        return self.accessor(rows, False, bufferView=self.view(rows.tobytes()))

    def attributes(self, given: dict[str, tuple[np.ndarray, bool]]) -> dict[str, int]:
        """Add attributes, interleaved in one view or each in its own, in rows of multiples of four bytes; some are
        sparse."""
        groups = [list(given)] if one_of(self.random, False, True) else [[name] for name in given]
        found = {}
        for group in groups:
            stored, sparse = {}, {}
            for name in group:
                rows, normalized = given[name]
                form = one_of(self.random, "full", "full", "sparse", "zeros")
                if form == "full":
                    stored[name] = rows
                    continue
                some = self.random.random(len(rows)) < (0.5 if form == "sparse" else 1.0)
                where = np.flatnonzero(some) if some.any() else np.array([0])
                index = where.astype(one_of(self.random, "<u1", "<u2", "<u4"))
                indices = {"bufferView": self.view(index.tobytes()), "componentType": COMPONENTS[index.dtype.str[1:]]}
                values = {"bufferView": self.view(rows[where].tobytes())}
                sparse[name] = {"sparse": {"count": len(where), "indices": indices, "values": values}}
                if form == "sparse":
                    stored[name] = rows.copy()
                    stored[name][where] = rows[::-1][where]  # beneath the sparse ones lie others
                else:
                    found[name] = self.accessor(rows, normalized, **sparse[name])
            found |= self._interleaved(stored, {name: given[name][1] for name in stored}, sparse)
        return found

    def _interleaved(self, stored: dict, normalized: dict, sparse: dict) -> dict[str, int]:
        if not stored:
            return {}
        sizes = {name: rows.dtype.itemsize * rows.shape[1] for name, rows in stored.items()}
        starts, stride = {}, 4 * int(self.random.integers(2))
        for name, size in sizes.items():
            starts[name], stride = stride, stride + size + -size % 4
        stride += 4 * int(self.random.integers(2))
        count = len(next(iter(stored.values())))
        block = self.random.integers(0, 256, (count, stride)).astype(np.uint8)
        for name, rows in stored.items():
            block[:, starts[name] : starts[name] + sizes[name]] = (
                np.ascontiguousarray(rows).view(np.uint8).reshape(count, -1)
            )
        tight = len(stored) == 1 and stride == next(iter(sizes.values()))
        view = self.view(block.tobytes(), **({} if tight else {"byteStride": stride}))
        return {
            name: self.accessor(rows, normalized[name], bufferView=view, **sparse.get(name, {}),
                                **({"byteOffset": starts[name]} if starts[name] else {}))
            for name, rows in stored.items()
        }  # fmt: skip

    def lists(self, glb: bool) -> tuple[dict[str, list], bytes | None, dict[str, bytes]]:
        """Return the entries of the file, the chunk of a GLB, and files next to it."""
        files, entries, chunk = {}, [], None
        for number, buffer in enumerate(self.buffers):
            entry: dict = {"byteLength": len(buffer)}
            if glb and number == 0 and one_of(self.random, True, True, False):
                chunk = bytes(buffer) + bytes(-len(buffer) % 4)
            elif one_of(self.random, True, False):
                kind = one_of(self.random, "application/octet-stream", "application/gltf-buffer")
                entry["uri"] = f"data:{kind};base64,{base64.b64encode(buffer).decode()}"
            else:
                entry["uri"], files[f"part {number}.bin"] = f"part%20{number}.bin", bytes(buffer)
            entries.append(entry)
        return {"buffers": entries, "bufferViews": self.views, "accessors": self.accessors}, chunk, files


def numbers(random: np.random.Generator, shape: tuple, types: tuple[str, ...]) -> tuple[Any, bool, np.ndarray]:
    """Return rows of one of the types, whose capital letter means normalised; and what they mean."""
    kind = one_of(random, *types)
    if kind == "f4":
        rows = (random.integers(0, 65, shape) / 64).astype("<f4")
        return rows, False, rows.astype(np.float64)
    info = np.iinfo(kind.lower())
    rows = random.integers(info.min, info.max + 1, shape).astype(f"<{kind.lower()}")
    rows[random.random(shape) < 0.1] = info.min
    return rows, kind.isupper(), np.maximum(rows / info.max, -1.0) if kind.isupper() else rows.astype(np.float64)


def topology(random: np.random.Generator) -> tuple[dict[str, int], np.ndarray | None, int, np.ndarray]:
    """Return the mode, indices or None, the number of vertices, and the triangles."""
    mode = one_of(random, None, 4, 5, 6)
    count = int(random.integers(3, 9))
    flat = np.arange(count)
    indexed = one_of(random, True, True, False)
    if mode in (None, 4):
        flat = (
            np.concatenate([random.permutation(count)[:3] for _ in range(3)]) if indexed else np.arange(count // 3 * 3)
        )
        triangles = flat.reshape(-1, 3).tolist()
    else:
        flat = random.integers(0, count, 8) if indexed else flat
        rows = flat.tolist()
        if mode == 6:
            triangles = [[b, c, rows[0]] for b, c in itertools.pairwise(rows[1:])]
        else:
            threes = list(zip(rows, rows[1:], rows[2:], strict=False))
            triangles = [[a, c, b] if k % 2 else [a, b, c] for k, (a, b, c) in enumerate(threes) if len({a, b, c}) == 3]
    given = {} if mode is None else {"mode": mode}
    if not triangles:  # a strip of repeated vertices
        return {}, None, 3, np.arange(3).reshape(1, 3)
    return given, flat if indexed else None, len(flat) if not indexed else count, np.array(triangles)


def primitive(random: np.random.Generator, storage: Storage, quantized: bool) -> tuple[dict, ExpectedMesh]:
    given, indices, count, triangles = topology(random)
    whole = ("f4", "i1", "u1", "i2", "u2", "I1", "U1", "I2", "U2") if quantized else ("f4",)
    rows, normalized, positions = numbers(random, (count, 3), whole)
    attributes, colors, uvs, normals = {"POSITION": (rows, normalized)}, None, None, None
    if one_of(random, True, False):
        rows, normalized, colors = numbers(random, (count, one_of(random, 3, 4)), ("f4", "U1", "U2"))
        attributes["COLOR_0"] = rows, normalized
    if one_of(random, True, False):
        rows, normalized, uvs = numbers(random, (count, 2), ("f4", "U1", "U2", *(("i2",) if quantized else ())))
        attributes["TEXCOORD_0"] = rows, normalized
        uvs = np.stack([uvs[:, 0], 1 - uvs[:, 1]], 1)
    if one_of(random, True, False):
        rows, normalized, normals = numbers(random, (count, 3), ("f4", *(("I1", "I2") if quantized else ())))
        zero = (rows == 0).all(1)
        rows[zero], normals[zero] = np.iinfo(rows.dtype).max if normalized else 1.0, 1.0
        attributes["NORMAL"] = rows, normalized
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    given["attributes"] = storage.attributes(attributes)
    if indices is not None:
        given["indices"] = storage.indices(indices)
    values = (None if v is None else v[triangles] for v in (positions, colors, uvs, normals))
    corners, colors, uvs, normals = values
    return given, ExpectedMesh(corners, None if colors is None else colors[..., :3], uvs, normals)


def node(random: np.random.Generator) -> tuple[dict, np.ndarray]:
    """Return a node that is shifted, rotated and scaled, perhaps mirrored, by parts or by a matrix; and its matrix."""
    quaternion = random.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    shift, scale = random.integers(-8, 9, 3) / 4, random.choice([-2.0, -0.5, 0.5, 1.0, 2.0], 3)
    parts = {"translation": shift, "rotation": quaternion, "scale": scale}
    form = one_of(random, "parts", "parts", "matrix")
    used = parts if form == "matrix" else {name: parts[name] for name in parts if random.random() < 0.6}
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(*used.get("rotation", (0, 0, 0, 1))) @ np.diag(used.get("scale", (1, 1, 1)))
    matrix[:3, 3] = used.get("translation", 0)
    written = {"matrix": matrix.T.reshape(-1)} if form == "matrix" else used
    return {name: values.tolist() for name, values in written.items()}, matrix


@st.composite
def gltf_files(draw: Draw) -> DrawnFile:
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    storage = Storage(random, draw(st.integers(1, 3)))
    quantized, extensions = one_of(random, False, True), set()
    meshes: list[tuple[dict, list[ExpectedMesh]]] = []
    for _ in range(draw(st.integers(1, 2))):
        made = [primitive(random, storage, quantized) for _ in range(draw(st.integers(1, 2)))]
        meshes.append(({"primitives": [given for given, _ in made]}, [shown for _, shown in made]))
    if quantized:
        extensions.add("KHR_mesh_quantization")

    # Nodes as they were drawn, each below an earlier one or none, and then in any order.
    count = draw(st.integers(1, 6))
    parents = [-1, *(int(random.integers(-1, k)) for k in range(1, count))]
    order = random.permutation(count).tolist()  # where each stands in the file
    nodes: list[dict] = [{} for _ in range(count)]
    worlds, visible, holds = [], [], []
    for k, parent in enumerate(parents):
        given, matrix = node(random)
        worlds.append(matrix if parent < 0 else worlds[parent] @ matrix)
        hidden = k > 0 and one_of(random, False, False, True)
        visible.append(not hidden and (parent < 0 or visible[parent]))
        holds.append(int(random.integers(len(meshes))) if k == 0 or one_of(random, True, False) else None)
        if holds[k] is not None:
            given["mesh"] = holds[k]
        if hidden or random.random() < 0.1:
            given["extensions"] = {"KHR_node_visibility": {"visible": not hidden}}
            extensions.add("KHR_node_visibility")
        below = [order[child] for child in range(count) if parents[child] == k]
        nodes[order[k]] = given | ({"children": below} if below else {})

    roots = [order[k] for k in range(count) if parents[k] < 0]
    first_only = False
    scenes: dict[str, Any] = {"scenes": [{"nodes": roots}]}
    form = one_of(random, "scenes", "scene", "second", "none")
    if form == "scene":
        scenes["scene"] = 0
    elif form == "second":
        scenes = {"scenes": [{"nodes": roots}, {"nodes": [order[0]]}], "scene": 1}
        first_only = True
    elif form == "none":
        scenes, roots = {}, sorted(roots)

    def walk(index: int) -> list[int]:
        k = order.index(index)
        return [k, *(found for child in nodes[index].get("children", []) for found in walk(child))]

    seen = [k for root in ([order[0]] if first_only else roots) for k in walk(root) if visible[k]]
    shown = [
        placed(one, worlds[k])
        for number, (_, primitives) in enumerate(meshes)
        for one in primitives
        for k in seen
        if holds[k] == number
    ]

    for thing in (*nodes, *storage.views, *storage.accessors, *(mesh for mesh, _ in meshes)):
        if random.random() < 0.1:
            thing["name"] = str(random.choice(NAMES))
        if random.random() < 0.1:
            thing["extras"] = {"extensions": {"x": [1]}, "weights": None}
    glb = one_of(random, True, False)
    lists, chunk, files = storage.lists(glb)
    tree = {"asset": {"version": "2.0"}, **scenes, "nodes": nodes, "meshes": [mesh for mesh, _ in meshes], **lists}
    if extensions:
        tree["extensionsUsed"] = sorted(extensions)
        if one_of(random, True, False):
            tree["extensionsRequired"] = sorted(extensions)
    if one_of(random, True, False):
        tree = dict(reversed(tree.items()))
    text = json.dumps(tree, indent=one_of(random, None, 1, "\t"), ensure_ascii=one_of(random, True, False)).encode()
    if not glb:
        return DrawnFile({"a.gltf": one_of(random, b"", b"\n ", b"\xef\xbb\xbf") + text, **files}, shown)
    text += b" " * (-len(text) % 4)
    chunks = [(b"JSON", text), *([(b"BIN\0", chunk)] if chunk is not None else [])]
    if one_of(random, False, False, True):
        chunks.append((b"ODD\0", random.bytes(8)))  # of a type that readers must ignore
    content = b"".join(struct.pack("<I4s", len(data), name) + data for name, data in chunks)
    return DrawnFile({"a.glb": struct.pack("<4sII", b"glTF", 2, 12 + len(content)) + content, **files}, shown)
