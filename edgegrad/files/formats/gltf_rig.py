"""What bends in glTF files: nodes that move one another, skins, morph targets and animations, as numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .gltf import File, entry
from .gltf_arrays import Arrays, Geometry, normalised
from .gltf_material import Primitive
from .gltf_nodes import Placed, matrix_of, placed
from .gltf_scene import primitives
from .gltf_texture import Images
from .part import Fault
from .source import Source

PATHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 0}
INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
WHOLE = 0.01  # by so much the weights of a vertex may differ from 1 in all, which is rounding


class Node(NamedTuple):
    """A node of the scene, as a joint."""

    name: str
    parent: int  # among the nodes; −1 of none
    translation: np.ndarray  # (3,)
    rotation: np.ndarray  # (4,) unit quaternion x, y, z, w
    stretch: np.ndarray  # (3, 3), applied before the rotation


class Bound(NamedTuple):
    """How the vertices of a primitive hang on joints, and what moves them before."""

    joints: np.ndarray  # (n,) nodes
    inverse_binds: np.ndarray  # (n, 4, 4), from where the vertices are to each joint
    weights: np.ndarray  # (N, n), whose rows add up to 1
    morphs: int  # which of the rig's morphs is its first
    targets: np.ndarray  # (M, N, 3) of positions
    normal_targets: np.ndarray  # (M, N, 3) of normals


class Channel(NamedTuple):
    """What an animation does to a node."""

    path: str  # one of PATHS
    node: int
    times: np.ndarray  # (K,) seconds, ascending
    values: np.ndarray  # (K, n); of splines (K, 3, n): tangent in, value, tangent out
    interpolation: str


class RigFile(NamedTuple):
    """All of a file."""

    nodes: list[Node]  # each after its parent
    parts: list[tuple[str, Primitive, Bound]]
    morphs: list[str]  # their names
    morph_weights: list[float]  # at rest
    morphs_of: dict[int, tuple[int, int]]  # by node, its first morph and their number
    animations: list[tuple[str, list[Channel]]]


def read(file: File, source: Source) -> RigFile:
    """Raises Fault or FileNotFoundError."""
    arrays = Arrays(file, source.folder)
    images = Images(arrays)
    there = list(placed(file.tree))
    places = {at.number: k for k, at in enumerate(there)}
    names = _names(there)
    nodes = [_node(name, at, places) for name, at in zip(names, there, strict=True)]
    _check_joints(file.tree, places)
    rig = RigFile(nodes, [], [], [], {}, [])
    for k, at in enumerate(there):
        if at.visible and "mesh" in at.node:
            _add_mesh(rig, k, at, file, images, source, places)
    rig.animations.extend(_animations(arrays, file.tree, places, source))
    return rig


def _add_mesh(
    rig: RigFile, k: int, at: Placed, file: File, images: Images, source: Source, places: dict[int, int]
) -> None:
    mesh, first = entry(file.tree, "meshes", at.node["mesh"]), len(rig.morphs)
    counts = {len(primitive.get("targets", [])) for primitive in mesh["primitives"]}
    if len(counts) > 1:
        raise Fault(
            f"mesh {at.node['mesh']}: expected as many morph targets in each primitive, got {sorted(counts)}; export it again"
        )
    if count := counts.pop():
        given = mesh.get("extras", {})
        own = given.get("targetNames", []) if isinstance(given, dict) else []
        if len(own) != count:
            own = [f"target {n}" for n in range(count)]
        weights = at.node.get("weights", mesh.get("weights", [0.0] * count))
        if len(weights) != count:
            raise Fault(
                f"mesh {at.node['mesh']}: expected {count} weights for its morph targets, got {len(weights)}; export it again"
            )
        taken = set(rig.morphs)
        rig.morphs.extend(str(n) if n not in taken else f"{rig.nodes[k].name}: {n}" for n in own)
        rig.morph_weights.extend(float(w) for w in weights)
        rig.morphs_of[k] = first, count
    for name, primitive in primitives(file, at.node["mesh"], images, source):
        try:
            if "skin" in at.node:
                joints, inverse_binds = _skin(images.arrays, file.tree, at.node["skin"], places)
                weights = _weights(primitive.geometry, len(primitive.positions), len(joints), name, source)
                used = np.flatnonzero(weights.any(0))  # the others move nothing
                joints, inverse_binds, weights = joints[used], inverse_binds[used], weights[:, used]
            else:
                joints, inverse_binds, weights = np.array([k]), np.eye(4)[None], np.ones((len(primitive.positions), 1))
            targets = [_targets(primitive.geometry, key, primitive.positions) for key in ("POSITION", "NORMAL")]
        except Fault as fault:
            raise Fault(f"part {name[:60]!r}: {fault}") from fault.__cause__
        rig.parts.append((name, primitive, Bound(joints, inverse_binds, weights, first, *targets)))


def _names(there: list[Placed]) -> list[str]:
    """Each once."""
    found: list[str] = []
    taken: set[str] = set()
    for at in there:
        name = str(at.node.get("name", f"node {at.number}"))
        name = f"{name} ({at.number})" if name in taken else name
        taken.add(name)
        found.append(name)
    return found


def _node(name: str, at: Placed, places: dict[int, int]) -> Node:
    parent = -1 if at.above is None else places[at.above]
    matrix = matrix_of(at.node)
    if "matrix" not in at.node:
        x = np.asarray(at.node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
        scale = np.diag(np.asarray(at.node.get("scale", (1.0, 1.0, 1.0)), np.float64))
        return Node(name, parent, matrix[:3, 3], x / max(np.linalg.norm(x), 1e-30), scale)
    # The polar decomposition A = R S; a scale by the axes gives a diagonal S.
    U, s, Vt = np.linalg.svd(matrix[:3, :3])
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R, S = U @ mirror @ Vt, Vt.T @ mirror @ np.diag(s) @ Vt
    return Node(name, parent, matrix[:3, 3], _quaternion(R), S)


def _quaternion(R: np.ndarray) -> np.ndarray:
    """(4,) x, y, z, w of a rotation: the eigenvector of Bar-Itzhack's matrix (2000), exact for a rotation."""
    K = np.array([
        [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
        [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
        [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
    ])  # fmt: skip
    return np.linalg.eigh(K)[1][:, -1]


def _check_joints(tree: dict[str, Any], places: dict[int, int]) -> None:
    """Raises Fault where the scene lacks a joint of its skins."""
    for number in sorted(
        {node["skin"] for k, node in enumerate(tree.get("nodes", [])) if k in places and "skin" in node}
    ):
        skin = entry(tree, "skins", number)
        for joint in skin["joints"]:
            if joint not in places:
                node = entry(tree, "nodes", joint)
                raise Fault(
                    f"skin {skin.get('name', number)!r}: expected joints in the scene, got node {joint} "
                    f"({str(node.get('name', 'without a name'))[:60]!r}), which is not; add its root to the scene"
                )


def _skin(arrays: Arrays, tree: dict[str, Any], number: Any, places: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    skin = entry(tree, "skins", number)
    joints = np.array([places[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" not in skin:
        return joints, np.tile(np.eye(4), (len(joints), 1, 1))
    rows = arrays.get(skin["inverseBindMatrices"])
    if rows.dtype.kind != "f" or rows.shape[1] != 16 or len(rows) < len(joints):
        raise Fault(
            f"expected {len(joints)} inverse bind matrices of floats, got {rows.shape} {rows.dtype}; export it again"
        )
    return joints, rows[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)


def _weights(geometry: Geometry, count: int, joints: int, name: str, source: Source) -> np.ndarray:
    """(N, n), whose rows add up to 1."""
    found, number = np.zeros((count, joints)), 0
    while (index := geometry.integers(f"JOINTS_{number}")) is not None:
        weights = geometry.attribute(f"WEIGHTS_{number}")
        if weights is None or weights.shape != (count, 4) or index.shape != (count, 4):
            got = "none" if weights is None else f"{index.shape} and {weights.shape}"
            raise Fault(
                f"expected JOINTS_{number} and WEIGHTS_{number} of shape {(count, 4)}, got {got}; export it again"
            )
        if not np.isfinite(weights).all() or (weights < 0.0).any():
            bad = int(np.argwhere(~((weights >= 0.0) & np.isfinite(weights)))[0, 0])
            raise Fault(f"expected WEIGHTS_{number} from 0 up, got {weights[bad].tolist()} at vertex {bad}; repair it")
        index = np.where(weights > 0.0, index, 0)  # what has no weight may point anywhere
        if int(index.max()) >= joints:
            raise Fault(f"expected JOINTS_{number} from 0 to {joints - 1}, got {int(index.max())}; export it again")
        np.add.at(found, (np.arange(count)[:, None], index), weights)
        number += 1
    if number == 0:
        raise Fault("expected JOINTS_0 and WEIGHTS_0 for its skin, got none; export it again")
    total = found.sum(1, keepdims=True)
    if (total <= 0.0).any():
        bad = int(np.argwhere(total[:, 0] <= 0.0)[0, 0])
        raise Fault(f"expected weights that add up to 1, got 0 at vertex {bad}; bind it to a joint")
    worst = float(np.abs(total - 1.0).max())
    if worst > WHOLE:
        source.unsupported.note(
            f"weights of {name!r} that add up to 1 only within {worst:.2g}", "divided by their sums"
        )
    return found / total


def _targets(geometry: Geometry, name: str, positions: np.ndarray) -> np.ndarray:
    """(M, N, 3)"""
    rows = geometry.targets(name, positions.shape)
    whole = [np.zeros(positions.shape) if row is None else row for row in rows]
    return np.stack(whole) if whole else np.zeros((0, *positions.shape))


def _animations(
    arrays: Arrays, tree: dict[str, Any], places: dict[int, int], source: Source
) -> list[tuple[str, list[Channel]]]:
    found, taken = [], set()
    for number, animation in enumerate(tree.get("animations", [])):
        name = str(animation.get("name", f"animation {number}"))
        name = f"{name} ({number})" if name in taken else name
        taken.add(name)
        channels = []
        for channel in animation["channels"]:
            target = channel["target"]
            if target["path"] not in PATHS:
                source.unsupported.note(f"animation of {target['path']!r}")
            elif target.get("node") in places:
                try:
                    channels.append(_channel(arrays, tree, animation, channel, places))
                except Fault as fault:
                    raise Fault(f"animation {name[:60]!r}: {fault}") from fault.__cause__
        found.append((name, channels))
    return found


def _channel(
    arrays: Arrays, tree: dict[str, Any], animation: dict[str, Any], channel: dict[str, Any], places: dict[int, int]
) -> Channel:
    sampler, target = entry(animation, "samplers", channel["sampler"]), channel["target"]
    path, interpolation = target["path"], sampler.get("interpolation", "LINEAR")
    if interpolation not in INTERPOLATIONS:
        raise Fault(
            f"expected an interpolation among {', '.join(INTERPOLATIONS)}, got {interpolation!r}; export it again"
        )
    times = arrays.get(sampler["input"])
    if (
        times.dtype.kind != "f"
        or times.shape[1] != 1
        or not (np.isfinite(times).all() and (np.diff(times[:, 0]) > 0).all())
    ):
        raise Fault(f"expected ascending times in seconds for {path}, got {times[:5, 0].tolist()}, …; export it again")
    values = arrays.get(sampler["output"])
    values = values.astype(np.float64) if values.dtype.kind == "f" else normalised(values)
    node = entry(tree, "nodes", target["node"])
    columns = PATHS[path] or len(entry(tree, "meshes", node.get("mesh"))["primitives"][0].get("targets", []))
    each = 3 if interpolation == "CUBICSPLINE" else 1
    if columns == 0 or values.size != len(times) * each * columns or not np.isfinite(values).all():
        raise Fault(
            f"expected {len(times)} × {each} × {columns} finite numbers for {path}, got shape {values.shape}; export it again"
        )
    shape = (len(times), 3, columns) if each == 3 else (len(times), columns)
    return Channel(path, places[target["node"]], times[:, 0].astype(np.float64), values.reshape(shape), interpolation)
