"""glTF samples with skins and morph targets, after the descriptions of Khronos' own, and their vertices in float64
numpy."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Sample:
    """A glTF file as it is written; `numbers` are what each accessor means, float64."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "buffers": []}
        self.numbers: list[np.ndarray] = []

    def view(self, content: bytes) -> int:
        uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
        self.tree["buffers"].append({"byteLength": len(content), "uri": uri})
        self.tree["bufferViews"].append({"buffer": len(self.tree["buffers"]) - 1, "byteLength": len(content)})
        return len(self.tree["bufferViews"]) - 1

    def add(self, rows: Any, dtype: str = "<f4", normalized: bool = False, sparse: bool = False) -> int:
        """Add rows (N, K) or (N,), or matrices (N, 4, 4). Normalised ones hold numbers from −1 or 0 to 1; sparse ones
        leave out zeros."""
        array = np.asarray(rows)
        if array.ndim == 3 and array.shape[1:] == (4, 4):
            array = array.transpose(0, 2, 1).reshape(-1, 16)  # column by column
        if normalized:
            array = np.round(array * np.iinfo(dtype).max)
        array = np.ascontiguousarray(array.astype(dtype))
        columns = 1 if array.ndim == 1 else array.shape[1]
        given: dict[str, Any] = {"componentType": COMPONENTS[dtype[1:]], "count": len(array), "type": KINDS[columns]}
        if normalized:
            given["normalized"] = True
        if sparse:
            where = np.flatnonzero(array.reshape(len(array), -1).any(1))
            indices = {"bufferView": self.view(where.astype("<u2").tobytes()), "componentType": COMPONENTS["u2"]}
            values = {"bufferView": self.view(array[where].tobytes())}
            given["sparse"] = {"count": len(where), "indices": indices, "values": values}
        else:
            given["bufferView"] = self.view(array.tobytes())
        self.tree["accessors"].append(given)
        number = array.astype(np.float64)
        self.numbers.append(np.maximum(number / np.iinfo(dtype).max, -1.0) if normalized else number)
        return len(self.numbers) - 1

    def animation(self, name: str, *channels: tuple[int, str, Any, Any, str]) -> None:
        """Add an animation of channels (node, path, times, values, interpolation)."""
        samplers, targets = [], []
        for node, path, times, values, interpolation in channels:
            values = np.asarray(values, np.float64)
            rows = values.reshape(-1) if path == "weights" else values.reshape(-1, values.shape[-1])
            samplers.append({"input": self.add(times), "output": self.add(rows), "interpolation": interpolation})
            targets.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
        self.tree.setdefault("animations", []).append({"name": name, "channels": targets, "samplers": samplers})

    def write(self, folder: Path, name: str = "a.gltf") -> Path:
        path = folder / name
        path.write_text(json.dumps(self.tree))
        return path


# -- where vertices are -----------------------------------------------------------------------------------------------


class Place(NamedTuple):
    """A primitive in the world."""

    positions: np.ndarray  # (F, 3, 3) of corners
    normals: np.ndarray | None


def quaternion_matrix(q: np.ndarray) -> np.ndarray:
    x, y, z, w = np.asarray(q, np.float64) / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def sampled(sample: Sample, sampler: dict, path: str, columns: int, t: float) -> np.ndarray:
    """Return the sampled value, by appendix C of glTF 2.0."""
    times, values = sample.numbers[sampler["input"]], sample.numbers[sampler["output"]]
    kind = sampler["interpolation"]
    values = values.reshape(len(times), 3, columns) if kind == "CUBICSPLINE" else values.reshape(len(times), columns)
    keys = values[:, 1] if kind == "CUBICSPLINE" else values
    if t <= times[0] or t >= times[-1]:
        v = keys[0] if t <= times[0] else keys[-1]
        return v / np.linalg.norm(v) if path == "rotation" else v
    k = int(np.searchsorted(times, t, side="right")) - 1
    td = times[k + 1] - times[k]
    s = (t - times[k]) / td
    if kind == "STEP":
        v = keys[k]
    elif kind == "CUBICSPLINE":
        v = (
            (2 * s**3 - 3 * s**2 + 1) * keys[k]
            + td * (s**3 - 2 * s**2 + s) * values[k, 2]
            + (-2 * s**3 + 3 * s**2) * keys[k + 1]
            + td * (s**3 - s**2) * values[k + 1, 0]
        )
    elif path == "rotation":
        a, b = (v / np.linalg.norm(v) for v in keys[k : k + 2])
        d = float(a @ b)
        angle = math.acos(min(1.0, abs(d)))
        v = (
            a
            if angle < 1e-9
            else (math.sin(angle * (1 - s)) * a + math.copysign(1, d) * math.sin(angle * s) * b) / math.sin(angle)
        )
    else:
        v = (1 - s) * keys[k] + s * keys[k + 1]
    return v / np.linalg.norm(v) if path == "rotation" else v


def places(sample: Sample, animation: int | None = None, t: float = 0.0) -> list[Place]:
    """Return every primitive in the order of nodes from the scene's roots down, depth first."""
    tree = sample.tree
    nodes = [dict(node) for node in tree["nodes"]]
    if animation is not None:
        given = tree["animations"][animation]
        for channel in given["channels"]:
            node, path = channel["target"]["node"], channel["target"]["path"]
            columns = {"rotation": 4, "weights": 0}.get(path, 3)
            if path == "weights":
                columns = len(tree["meshes"][nodes[node]["mesh"]]["primitives"][0]["targets"])
            nodes[node][path] = sampled(sample, given["samplers"][channel["sampler"]], path, columns, t)
    world: dict[int, np.ndarray] = {}
    order = []

    def visit(index: int, above: np.ndarray) -> None:
        node = nodes[index]
        local = np.eye(4)
        if "matrix" in node:
            local = np.array(node["matrix"], np.float64).reshape(4, 4).T
        else:
            local[:3, :3] = quaternion_matrix(node.get("rotation", [0, 0, 0, 1])) @ np.diag(
                node.get("scale", [1, 1, 1])
            )
            local[:3, 3] = node.get("translation", [0, 0, 0])
        world[index] = above @ local
        order.append(index)
        for child in node.get("children", []):
            visit(child, world[index])

    for root in tree["scenes"][0]["nodes"]:
        visit(root, np.eye(4))
    found = []
    for index in order:
        if "mesh" in nodes[index]:
            mesh = tree["meshes"][nodes[index]["mesh"]]
            for primitive in mesh["primitives"]:
                found.append(_placed(sample, primitive, mesh, nodes[index], world, index))
    return found


def _placed(sample: Sample, primitive: dict, mesh: dict, node: dict, world: dict[int, np.ndarray], index: int) -> Place:
    given = primitive["attributes"]
    p, n = sample.numbers[given["POSITION"]], None
    n = sample.numbers[given["NORMAL"]] if "NORMAL" in given else None
    weights = node.get("weights", mesh.get("weights"))
    for k, target in enumerate(primitive.get("targets", [])):
        w = 0.0 if weights is None else float(weights[k])
        if "POSITION" in target:
            p = p + w * sample.numbers[target["POSITION"]]
        if n is not None and "NORMAL" in target:
            n = n + w * sample.numbers[target["NORMAL"]]
    M = np.tile(world[index], (len(p), 1, 1))
    if "skin" in node:
        skin = sample.tree["skins"][node["skin"]]
        if "inverseBindMatrices" in skin:
            inverse = sample.numbers[skin["inverseBindMatrices"]].reshape(-1, 4, 4).transpose(0, 2, 1)
        else:
            inverse = np.tile(np.eye(4), (len(skin["joints"]), 1, 1))
        M, total, k = np.zeros((len(p), 4, 4)), np.zeros((len(p), 1, 1)), 0
        while f"JOINTS_{k}" in given:
            joints, w = sample.numbers[given[f"JOINTS_{k}"]].astype(int), sample.numbers[given[f"WEIGHTS_{k}"]]
            for v in range(len(p)):
                for j, weight in zip(joints[v], w[v], strict=True):
                    M[v] += weight * world[skin["joints"][j]] @ inverse[j]
                    total[v] += weight
            k += 1
        M = M / total
    corners = sample.numbers[primitive["indices"]].astype(int).reshape(-1, 3)
    moved = np.einsum("vij,vj->vi", M[:, :3, :3], p) + M[:, :3, 3]
    if n is not None:
        n = np.einsum("vij,vj->vi", np.linalg.inv(M[:, :3, :3]).transpose(0, 2, 1), n)
        n = (n / np.linalg.norm(n, axis=1, keepdims=True))[corners]
    return Place(moved[corners], n)


# -- the samples ------------------------------------------------------------------------------------------------------


def turn(axis: str, degrees: float) -> list[float]:
    q = [0.0, 0.0, 0.0, math.cos(math.radians(degrees) / 2)]
    q["xyz".index(axis)] = math.sin(math.radians(degrees) / 2)
    return q


def simple_skin() -> Sample:
    """Return a strip of eight triangles on two joints, of which the upper one rotates about z and back."""
    sample = Sample()
    positions = [[x, 0.5 * k, 0.0] for k in range(5) for x in (0.0, 1.0)]
    triangles = [[2 * k + a, 2 * k + b, 2 * k + c] for k in range(4) for a, b, c in ((0, 1, 3), (0, 3, 2))]
    upper = np.repeat([0.0, 0.25, 0.5, 0.75, 1.0], 2)
    weights = np.stack([1 - upper, upper, 0 * upper, 0 * upper], 1)
    primitive = {
        "attributes": {
            "POSITION": sample.add(positions), "JOINTS_0": sample.add(np.tile([0, 1, 0, 0], (10, 1)), "<u2"),
            "WEIGHTS_0": sample.add(weights),
        },
        "indices": sample.add(np.reshape(triangles, -1), "<u2"),
    }  # fmt: skip
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[:, :3, 3] = [-0.5, -1.0, 0.0]
    sample.tree |= {
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"skin": 0, "mesh": 0, "translation": [7, 8, 9]},  # which does not count
            {"children": [2], "translation": [0.5, 1.0, 0.0]},
            {"rotation": [0.0, 0.0, 0.0, 1.0], "name": "upper"},
        ],
        "meshes": [{"primitives": [primitive]}],
        "skins": [{"inverseBindMatrices": sample.add(inverse), "joints": [1, 2]}],
    }  # fmt: skip
    turns = [turn("z", a) for a in (0, 45, 90, 45, 0, -45, -90, -45, 0)]
    sample.animation("bend", (2, "rotation", np.arange(9) * 0.5, turns, "LINEAR"))
    return sample


def simple_morph() -> Sample:
    """Return a triangle with two morph targets, the second of which is sparse."""
    sample = Sample()
    primitive = {
        "attributes": {"POSITION": sample.add([[0, 0, 0], [1, 0, 0], [0.5, 0.5, 0]])},
        "targets": [
            {"POSITION": sample.add([[-1, 1, 0], [0, 0, 0], [0, 0, 0]])},
            {"POSITION": sample.add([[0, 0, 0], [0, 0, 0], [1, 1, 0]], sparse=True)},
        ],
        "indices": sample.add([0, 1, 2], "<u1"),
    }
    sample.tree |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive], "weights": [0.5, 0.25], "extras": {"targetNames": ["left", "up"]}}],
    }
    sample.animation("morph", (0, "weights", [0, 1, 2, 3, 4], [[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]], "LINEAR"))
    return sample


def simple_sparse() -> Sample:
    """Return fourteen vertices in two rows, three of which are moved as differences to zeros."""
    sample = Sample()
    positions = np.array([[k % 7, k // 7, 0.0] for k in range(14)])
    positions[[8, 10, 12]] = [[1, 2, 0], [3, 3, 0], [5, 4, 0]]
    triangles = [[k + a, k + b, k + c] for k in range(6) for a, b, c in ((0, 8, 7), (0, 1, 8))]
    primitive = {
        "attributes": {"POSITION": sample.add(positions, sparse=True)},
        "indices": sample.add(np.reshape(triangles, -1), "<u2"),
    }
    sample.tree |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
    }
    return sample


CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7],
    [1, 7, 3],
])  # fmt: skip


def morph_cube() -> Sample:
    """Return a cube of 24 vertices with normals and two morph targets that move both."""
    sample = Sample()
    corners = CUBE[CUBE_FACES.reshape(-1)]
    a, b, c = corners.reshape(-1, 3, 3).transpose(1, 0, 2)
    normals = np.repeat(np.cross(b - a, c - a), 3, 0) / 4.0
    random = np.random.default_rng(4)
    rounded = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    lean = np.where(corners[:, 1:2] > 0, [[0.7, 0.2, -0.1]], 0.0)
    primitive = {
        "attributes": {"POSITION": sample.add(corners), "NORMAL": sample.add(normals)},
        "targets": [
            {"POSITION": sample.add(rounded - corners), "NORMAL": sample.add(rounded - normals)},
            {"POSITION": sample.add(lean, sparse=True), "NORMAL": sample.add(0.1 * random.normal(size=corners.shape))},
        ],
        "indices": sample.add(np.arange(36), "<u2"),
    }
    sample.tree |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": turn("x", 30), "scale": [1, 2, 0.5], "translation": [0, 1, 0]}],
        "meshes": [{"primitives": [primitive]}],
    }
    times = np.linspace(0.0, 4.0, 9)
    keys = np.stack([np.sin(times), np.cos(2 * times)], 1)
    sample.animation("Square", (0, "weights", times, keys, "LINEAR"))
    spline = np.stack([0.3 * keys, keys, -0.2 * keys], 1)
    sample.animation("Smooth", (0, "weights", times, spline, "CUBICSPLINE"))
    return sample


def interpolation() -> Sample:
    """Return nine cubes without a skin, which have scale, rotation and translation by steps, lines and splines."""
    sample = Sample()
    mesh = {
        "primitives": [
            {"attributes": {"POSITION": sample.add(CUBE)}, "indices": sample.add(CUBE_FACES.reshape(-1), "<u1")}
        ]
    }
    nodes = [{"mesh": 0, "translation": [3.0 * (k % 3), 3.0 * (k // 3), 0.0], "name": f"cube {k}"} for k in range(9)]
    sample.tree |= {"scenes": [{"nodes": list(range(9))}], "nodes": nodes, "meshes": [mesh]}
    times = np.array([0.0, 0.4, 1.1, 2.0])
    keys = {
        "scale": np.array([[1, 1, 1], [2, 0.5, 1], [0.3, 1, 2], [1, 1, 1]], np.float64),
        "rotation": np.array([turn("y", 0), turn("y", 150), turn("x", -120), turn("z", 200)]),
        "translation": np.array([[0, 0, 0], [1, 2, 3], [-1, 0, 1], [0, 0, 0]], np.float64),
    }
    channels = []
    for i, (path, values) in enumerate(keys.items()):
        for j, kind in enumerate(("STEP", "LINEAR", "CUBICSPLINE")):
            given = np.stack([-0.4 * values, values, 0.7 * values[::-1]], 1) if kind == "CUBICSPLINE" else values
            channels.append((3 * i + j, path, times, given, kind))
    sample.animation("all", *channels)
    return sample


def tube(segments: int, around: int, length: float, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, normals and triangles of an open tube along y."""
    y, angle = np.meshgrid(np.linspace(0, length, segments + 1), np.arange(around) * math.tau / around, indexing="ij")
    normals = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    positions = radius * normals + np.stack([0 * y, y, 0 * y], -1)
    row, column = np.meshgrid(np.arange(segments), np.arange(around), indexing="ij")
    a, b = row * around + column, row * around + (column + 1) % around
    triangles = np.stack([np.stack([a, b + around, b], -1), np.stack([a, a + around, b + around], -1)], -2)
    return positions.reshape(-1, 3), normals.reshape(-1, 3), triangles.reshape(-1, 3)


def walk() -> Sample:
    """Return a walk after CesiumMan and RiggedSimple: nineteen joints under rotated and scaled nodes, two meshes on one
    skin, weights in bytes, up to eight joints a vertex, and an animation that rotates, shifts and scales them."""
    sample, random = Sample(), np.random.default_rng(7)
    J = 19
    parents = [-1, 0, 1, 2, 3, 2, 5, 6, 2, 8, 9, 0, 11, 12, 13, 0, 15, 16, 17]
    names = ["hips", "spine", "chest", "neck", "head"]
    names += [
        f"{side}_{part}" for part in ("arm",) for side in ("left", "right") for part in ("shoulder", "elbow", "hand")
    ]
    names += [f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle", "toe")]
    local = [
        {"translation": (0.3 * random.normal(size=3)).tolist(), "rotation": random.normal(size=4)} for _ in range(J)
    ]
    nodes: list[dict[str, Any]] = [
        {"name": "Z_UP", "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1], "children": [1]},
        {"name": "Armature", "scale": [0.5, 0.5, 0.5], "children": [2, 3, 4]},
        {"name": "body", "mesh": 0, "skin": 0},
        {"name": "clothes", "mesh": 1, "skin": 0},
    ]
    for k in range(J):
        q = local[k]["rotation"] / np.linalg.norm(local[k]["rotation"])
        node = {"name": names[k], "translation": local[k]["translation"], "rotation": q.tolist()}
        if children := [4 + c for c in range(J) if parents[c] == k]:
            node["children"] = children
        nodes.append(node)
    meshes = []
    for number, (sets, dtype) in enumerate(((2, "<u1"), (1, "<u2"))):
        positions, normals, triangles = tube(9, 8, 2.0, 0.3 + 0.1 * number)
        weights = random.random((len(positions), 4 * sets)) ** 4
        weights /= weights.sum(1, keepdims=True)
        joints = np.stack([random.permutation(J)[: 4 * sets] for _ in positions])
        attributes = {"POSITION": sample.add(positions), "NORMAL": sample.add(normals)}
        for k in range(sets):
            attributes[f"JOINTS_{k}"] = sample.add(joints[:, 4 * k : 4 * k + 4], "<u1")
            attributes[f"WEIGHTS_{k}"] = sample.add(weights[:, 4 * k : 4 * k + 4], dtype, normalized=True)
        meshes.append({"primitives": [{"attributes": attributes, "indices": sample.add(triangles.reshape(-1), "<u2")}]})
    inverse = np.tile(np.eye(4), (J, 1, 1))
    for k in range(J):
        inverse[k, :3, :3] = quaternion_matrix(random.normal(size=4))
        inverse[k, :3, 3] = 0.3 * random.normal(size=3)
    sample.tree |= {
        "scenes": [{"nodes": [0]}], "nodes": nodes, "meshes": meshes,
        "skins": [{"inverseBindMatrices": sample.add(inverse), "joints": list(range(4, 4 + J)), "skeleton": 4}],
    }  # fmt: skip
    times = np.linspace(0.0, 2.0, 13)
    channels: list[tuple[int, str, Any, Any, str]] = []
    for k in range(J):
        turns = random.normal(size=(len(times), 4))
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        channels.append((4 + k, "rotation", times, turns, "LINEAR"))
        channels.append((4 + k, "translation", times, 0.3 * random.normal(size=(len(times), 3)), "LINEAR"))
        if k % 3 == 0:
            channels.append((4 + k, "scale", times, 0.8 + 0.4 * random.random((len(times), 3)), "LINEAR"))
    sample.animation("Walk", *channels)
    sample.animation("Rest")
    return sample


def rigged_simple() -> Sample:
    """Return a cylinder of 96 corners on two joints, without inverse bind matrices, under a rotated root."""
    sample = Sample()
    positions, _, triangles = tube(4, 12, 4.0, 0.5)
    upper = np.clip((positions[:, 1] - 1.5), 0.0, 1.0)
    weights = np.stack([1 - upper, upper, 0 * upper, 0 * upper], 1)
    primitive = {
        "attributes": {
            "POSITION": sample.add(positions), "JOINTS_0": sample.add(np.tile([0, 1, 0, 0], (len(positions), 1)), "<u1"),
            "WEIGHTS_0": sample.add(weights, "<u2", normalized=True),
        },
        "indices": sample.add(triangles.reshape(-1), "<u2"),
    }  # fmt: skip
    sample.tree |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"rotation": turn("x", -90), "children": [1, 2]},
            {"mesh": 0, "skin": 0},
            {"children": [3], "name": "lower"},
            {"name": "upper"},
        ],
        "meshes": [{"primitives": [primitive]}],
        "skins": [{"joints": [2, 3]}],
    }
    keys = np.array([turn("y", a) for a in (0, 40, -60)])
    spline = np.stack([0.2 * keys[::-1], keys, -0.3 * keys], 1)
    sample.animation("twist", (3, "rotation", [0.0, 1.0, 2.5], spline, "CUBICSPLINE"))
    return sample


SAMPLES = {
    "SimpleSkin": simple_skin, "SimpleMorph": simple_morph, "SimpleSparseAccessor": simple_sparse,
    "AnimatedMorphCube": morph_cube, "InterpolationTest": interpolation, "CesiumMan": walk, "RiggedSimple": rigged_simple,
}  # fmt: skip
