"""Moving parts of glTF files as numbers: nodes that move one another, skins, morph targets and animations."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...optional import require
from .context import LoadContext, unique_name
from .gltf import File, entry
from .gltf_arrays import Arrays, Geometry, normalised
from .gltf_material import Primitive
from .gltf_nodes import ROUNDED, Placed, matrix_of, node_name, placed, rotation_of
from .gltf_scene import primitives
from .gltf_texture import Images
from .part import FormatError

PATHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 0}
INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
WHOLE = 0.01  # by so much the weights of a vertex may differ from 1 in all, which is rounding


class RigNode(NamedTuple):
    name: str
    parent: int  # among the nodes; −1 of none
    translation: np.ndarray  # (3,)
    rotation: np.ndarray  # (4,) unit quaternion x, y, z, w
    stretch: np.ndarray  # (3, 3), applied before the rotation


class SkinBinding(NamedTuple):
    """The joints and weights of a primitive's vertices, and the morph targets that move them before."""

    joints: np.ndarray  # (n,) nodes
    inverse_binds: np.ndarray  # (n, 4, 4), from where the vertices are to each joint
    weights: np.ndarray  # (N, n), whose rows add up to 1
    morphs: int  # which of the rig's morphs is its first
    targets: np.ndarray  # (M, N, 3) of positions
    normal_targets: np.ndarray  # (M, N, 3) of normals


class AnimationChannel(NamedTuple):
    path: str  # one of PATHS
    node: int
    times: np.ndarray  # (K,) seconds, ascending
    values: np.ndarray  # (K, n); of splines (K, 3, n): tangent in, value, tangent out
    interpolation: str


class RigFile(NamedTuple):
    """All nodes, parts, morph targets and animations of a file."""

    nodes: list[RigNode]  # each after its parent
    parts: list[tuple[str, Primitive, SkinBinding]]
    morphs: list[str]  # their names
    morph_weights: list[float]  # at rest
    morphs_of: dict[int, tuple[int, int]]  # by node, its first morph and their number
    animations: list[tuple[str, list[AnimationChannel]]]


def read(file: File, context: LoadContext) -> RigFile:
    arrays = Arrays(file, context.folder)
    images = Images(arrays)
    there = list(placed(file.tree))
    places = {at.number: k for k, at in enumerate(there)}
    names = _names(there)
    nodes = [_node(name, at, places) for name, at in zip(names, there, strict=True)]
    _check_joints(file.tree, places)
    rig = RigFile(nodes, [], [], [], {}, [])
    for k, at in enumerate(there):
        if at.visible and "mesh" in at.node:
            _add_mesh(rig, k, at, file, images, context, places)
    rig.animations.extend(_animations(arrays, file.tree, places, context))
    return rig


def _add_mesh(
    rig: RigFile, k: int, at: Placed, file: File, images: Images, context: LoadContext, places: dict[int, int]
) -> None:
    mesh, first = entry(file.tree, "meshes", at.node["mesh"]), len(rig.morphs)
    found = list(primitives(file, at.node["mesh"], images, context))
    count = max((len(primitive.given.get("targets", [])) for _, primitive in found), default=0)
    try:
        moves = [[_targets(p.geometry, key, p.positions, count) for key in ("POSITION", "NORMAL")] for _, p in found]
    except FormatError as error:
        context.unread.note(f"morph targets of {_mesh_name(at, mesh)!r}", f"left out: {error}")
        count, moves = 0, [[np.zeros((0, *primitive.positions.shape))] * 2 for _, primitive in found]
    if count:
        rig.morphs.extend(_morph_names(rig, k, mesh, count))
        rig.morph_weights.extend(_morph_weights(at, mesh, count, context))
        rig.morphs_of[k] = first, count
    for (name, primitive), targets in zip(found, moves, strict=True):
        try:
            if at.skins(primitive.given):
                joints, inverse_binds = _skin(images.arrays, file.tree, at.node["skin"], places)
                weights = _weights(primitive.geometry, len(primitive.positions), len(joints), name, context)
                used = np.flatnonzero(weights.any(0))  # the others move nothing
                joints, inverse_binds, weights = joints[used], inverse_binds[used], weights[:, used]
            else:
                joints, inverse_binds, weights = np.array([k]), np.eye(4)[None], np.ones((len(primitive.positions), 1))
                if "skin" in at.node:
                    context.unread.note(
                        f"the skin of {name[:60]!r}, which has no JOINTS_0",
                        f"rigid with node {rig.nodes[k].name[:60]!r}",
                    )
        except FormatError as error:
            raise FormatError(f"part {name[:60]!r}: {error}") from error.__cause__
        rig.parts.append((name, primitive, SkinBinding(joints, inverse_binds, weights, first, *targets)))


def _mesh_name(at: Placed, mesh: dict[str, Any]) -> str:
    return str(mesh.get("name") or f"mesh {at.node['mesh']}")[:60]


def _morph_names(rig: RigFile, k: int, mesh: dict[str, Any], count: int) -> list[str]:
    """Return the names of extras.targetNames where there are as many as targets, each once among all of the rig."""
    extras = mesh.get("extras", {})
    given = extras.get("targetNames", []) if isinstance(extras, dict) else []
    given = given if isinstance(given, list) and len(given) == count else [""] * count
    found: list[str] = []
    for number, own in enumerate(given):
        name = str(own) if own else f"target {number}"
        found.append(unique_name({*rig.morphs, *found}, name, f"{rig.nodes[k].name}: {name}"))
    return found


def _morph_weights(at: Placed, mesh: dict[str, Any], count: int, context: LoadContext) -> list[float]:
    given = at.node.get("weights", mesh.get("weights", [0.0] * count))
    if len(given) != count:
        what = f"weights of {_mesh_name(at, mesh)!r}, {len(given)} for {count} morph targets"
        context.unread.note(what, "0 for each in their place")
        return [0.0] * count
    return [float(weight) for weight in given]


def _names(there: list[Placed]) -> list[str]:
    found: dict[str, None] = {}
    for at in there:
        found[unique_name(found, at.name, f"{at.name} ({at.number})")] = None
    return list(found)


def _node(name: str, at: Placed, places: dict[int, int]) -> RigNode:
    parent = -1 if at.above is None else places[at.above]
    matrix = matrix_of(at.node)
    if "matrix" not in at.node:
        scale = np.diag(np.asarray(at.node.get("scale", (1.0, 1.0, 1.0)), np.float64))
        return RigNode(name, parent, matrix[:3, 3], rotation_of(at.node), scale)
    # The polar decomposition A = R S; a scale by the axes gives a diagonal S.
    U, s, Vt = np.linalg.svd(matrix[:3, :3])
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R, S = U @ mirror @ Vt, Vt.T @ mirror @ np.diag(s) @ Vt
    transformations = require("trimesh.transformations", "trimesh", "reading meshes")
    return RigNode(name, parent, matrix[:3, 3], np.roll(transformations.quaternion_from_matrix(R), -1), S)


def _check_joints(tree: dict[str, Any], places: dict[int, int]) -> None:
    """Raise FormatError where the scene lacks a joint of its skins."""
    for number in sorted(
        {node["skin"] for k, node in enumerate(tree.get("nodes", [])) if k in places and "skin" in node}
    ):
        skin = entry(tree, "skins", number)
        for joint in skin["joints"]:
            if joint not in places:
                node = entry(tree, "nodes", joint)
                raise FormatError(
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
        raise FormatError(
            f"expected {len(joints)} inverse bind matrices of floats, got {rows.shape} {rows.dtype}; export it again"
        )
    return joints, rows[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)


def _weights(geometry: Geometry, count: int, joints: int, name: str, context: LoadContext) -> np.ndarray:
    """Return weights (N, n), whose rows add up to 1."""
    found, number = np.zeros((count, joints)), 0
    while (index := geometry.integers(f"JOINTS_{number}")) is not None:
        weights = geometry.attribute(f"WEIGHTS_{number}")
        if weights is None or weights.shape != (count, 4) or index.shape != (count, 4):
            got = "none" if weights is None else f"{index.shape} and {weights.shape}"
            raise FormatError(
                f"expected JOINTS_{number} and WEIGHTS_{number} of shape {(count, 4)}, got {got}; export it again"
            )
        if not np.isfinite(weights).all() or (weights < 0.0).any():
            bad = int(np.argwhere(~((weights >= 0.0) & np.isfinite(weights)))[0, 0])
            raise FormatError(
                f"expected WEIGHTS_{number} from 0 up, got {weights[bad].tolist()} at vertex {bad}; repair it"
            )
        index = np.where(weights > 0.0, index, 0)  # what has no weight may point anywhere
        if int(index.max()) >= joints:
            raise FormatError(
                f"expected JOINTS_{number} from 0 to {joints - 1}, got {int(index.max())}; export it again"
            )
        np.add.at(found, (np.arange(count)[:, None], index), weights)
        number += 1
    loose = found.sum(1) <= 0.0
    if loose.any():
        found[loose, 0] = 1.0
        context.unread.note(
            f"{int(loose.sum())} of {count} vertices of {name[:60]!r} whose weights are all 0, as vertex {int(loose.argmax())}",
            "bound to the first joint of the skin",
        )
    total = found.sum(1, keepdims=True)
    worst = float(np.abs(total - 1.0).max())
    if worst > WHOLE:
        context.unread.note(f"weights of {name!r} that add up to 1 only within {worst:.2g}", "divided by their sums")
    return found / total


def _targets(geometry: Geometry, name: str, positions: np.ndarray, count: int) -> np.ndarray:
    """Return differences (M, N, 3) of `count` targets, zeros for those that the primitive lacks. Raises FormatError."""
    rows = geometry.targets(name, positions.shape)
    rows += [None] * (count - len(rows))
    whole = [np.zeros(positions.shape) if row is None else row for row in rows]
    return np.stack(whole) if whole else np.zeros((0, *positions.shape))


def _animations(
    arrays: Arrays, tree: dict[str, Any], places: dict[int, int], context: LoadContext
) -> list[tuple[str, list[AnimationChannel]]]:
    """Return the channels of each animation by its name, and note those that cannot be read."""
    found: dict[str, list[AnimationChannel]] = {}
    for number, animation in enumerate(tree.get("animations", [])):
        name = str(animation.get("name") or f"animation {number}")
        name = unique_name(found, name, f"{name} ({number})")
        found[name] = channels = []
        for channel in animation["channels"]:
            target = channel["target"]
            if target["path"] not in PATHS:
                context.unread.note(f"animation of {target['path']!r}")
            elif (node := target.get("node")) in places:
                what = (
                    f"{target['path']} of node {node_name(node, tree['nodes'][node])[:60]!r} in animation {name[:60]!r}"
                )
                try:
                    channels.append(_channel(arrays, tree, animation, channel, places, what, context))
                except FormatError as error:
                    context.unread.note(what, f"left out: {error}")
            elif node is not None and not 0 <= node < len(tree.get("nodes", [])):
                context.unread.note(
                    f"{target['path']} of node {node} in animation {name[:60]!r}", "left out: there is no such node"
                )
    return list(found.items())


def _channel(
    arrays: Arrays, tree: dict[str, Any], animation: dict[str, Any], channel: dict[str, Any], places: dict[int, int],
    what: str, context: LoadContext,
) -> AnimationChannel:  # fmt: skip
    sampler, target = entry(animation, "samplers", channel["sampler"]), channel["target"]
    path, interpolation = target["path"], sampler.get("interpolation", "LINEAR")
    if interpolation not in INTERPOLATIONS:
        raise FormatError(
            f"expected an interpolation among {', '.join(INTERPOLATIONS)}, got {interpolation!r}; export it again"
        )
    times = arrays.get(sampler["input"])
    if (
        times.dtype.kind != "f"
        or times.shape[1] != 1
        or not (np.isfinite(times).all() and (np.diff(times[:, 0]) > 0).all())
    ):
        raise FormatError(
            f"expected ascending times in seconds for {path}, got {times[:5, 0].tolist()}, …; export it again"
        )
    values = arrays.get(sampler["output"])
    values = values.astype(np.float64) if values.dtype.kind == "f" else normalised(values)
    node = entry(tree, "nodes", target["node"])
    columns = PATHS[path] or max(
        len(primitive.get("targets", [])) for primitive in entry(tree, "meshes", node.get("mesh"))["primitives"]
    )
    each = 3 if interpolation == "CUBICSPLINE" else 1
    if columns == 0 or values.size != len(times) * each * columns or not np.isfinite(values).all():
        raise FormatError(
            f"expected {len(times)} × {each} × {columns} finite numbers for {path}, got shape {values.shape}; export it again"
        )
    values = values.reshape((len(times), 3, columns) if each == 3 else (len(times), columns))
    if path == "rotation":
        values = _unit(values, each == 3, what, context)
    return AnimationChannel(path, places[target["node"]], times[:, 0].astype(np.float64), values, interpolation)


def _unit(values: np.ndarray, cubic: bool, what: str, context: LoadContext) -> np.ndarray:
    """Return keys of rotations divided by the lengths of their quaternions, and tangents of splines with them. Bytes and shorts
    have these lengths to rounding; others are noted. Raises FormatError for a quaternion of zeros."""
    length = np.linalg.norm(values[:, 1] if cubic else values, axis=-1)
    worst = int(np.abs(length - 1.0).argmax())
    if not length.all():
        raise FormatError(f"expected unit quaternions, got zeros at key {int(length.argmin())}; repair it")
    if abs(length[worst] - 1.0) > ROUNDED:
        context.unread.note(f"{what}, whose key {worst} is of length {length[worst]:.3g}", "divided by it")
    return values / length.reshape(-1, *[1] * (values.ndim - 1))
