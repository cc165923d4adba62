"""Lights and cameras at the nodes of glTF files."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from ...camera.camera import Camera
from ...optional import require
from ...scene.lights import DirectionalLight, Light, PointLight, SpotLight
from .context import LoadContext, UnreadLog, unique_name
from .gltf import PUNCTUAL, VISIBILITY, entry
from .gltf_schema import explained
from .part import FormatError

ROUNDED = 0.01  # what rounding to normalised bytes may change of a quaternion's length
INSTEAD_OF_RANGE = "light falls off with the square of the distance, without an end"


class Placed(NamedTuple):
    """A node of the scene in its place."""

    number: int  # in the file's list of nodes
    above: int | None  # the node that it is within
    node: dict[str, Any]
    world: np.ndarray  # (4, 4), to the world
    visible: bool  # it and all nodes above it (KHR_node_visibility)

    def skins(self, primitive: dict[str, Any]) -> bool:
        """Return whether the node's skin moves a primitive of its mesh; one without JOINTS_0 is rigid with the node."""
        return "skin" in self.node and "JOINTS_0" in primitive["attributes"]

    def of_primitive(self, primitive: dict[str, Any]) -> np.ndarray:
        """Return the matrix (4, 4) of a primitive: a skinned one stands where its joints do (glTF 2.0, section 3.7.3.3), else
        at the node."""
        return np.eye(4) if self.skins(primitive) else self.world

    @property
    def name(self) -> str:
        return node_name(self.number, self.node)


def placed(tree: dict[str, Any]) -> Iterator[Placed]:
    """Yield the nodes of the scene, each before those below it; without scenes, all nodes. Raises FormatError where they are no
    tree."""
    if tree.get("scenes"):
        roots = entry(tree, "scenes", tree.get("scene", 0)).get("nodes", [])
    else:
        below = {child for node in tree.get("nodes", []) for child in node.get("children", [])}
        roots = [index for index in range(len(tree.get("nodes", []))) if index not in below]
    waiting = [(root, None, np.eye(4), True) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, parent, above, visible = waiting.pop()
        if index in seen:
            name = entry(tree, "nodes", index).get("name", "without a name")
            raise FormatError(
                f"expected a tree of nodes, got node {index} ({name}) below itself or two others; export it again"
            )
        seen.add(index)
        node = entry(tree, "nodes", index)
        found = Placed(index, parent, node, above @ matrix_of(node), visible and _is_visible(node))
        yield found
        waiting += [(child, index, found.world, found.visible) for child in reversed(node.get("children", []))]


def _is_visible(node: dict[str, Any]) -> bool:
    visible = node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True)
    if not isinstance(visible, bool):
        raise FormatError(f"expected true or false for visible of {VISIBILITY}, got {visible!r}; export it again")
    return visible


def matrix_of(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix (4, 4) of a node within its parent: the product of shift, rotation and scaling."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    transformations = require("trimesh.transformations", "trimesh", "reading meshes")
    x, y, z, w = rotation_of(node)
    shift = transformations.translation_matrix(node.get("translation", (0.0, 0.0, 0.0)))
    scale = np.diag((*node.get("scale", (1.0, 1.0, 1.0)), 1.0))
    return shift @ transformations.quaternion_matrix((w, x, y, z)) @ scale


def rotation_of(node: dict[str, Any]) -> np.ndarray:
    """Return the unit quaternion (4,) x, y, z, w; the identity where the file has zeros or numbers that are not finite."""
    given = np.asarray(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
    length = float(np.linalg.norm(given))
    return given / length if 0.0 < length < math.inf else np.array([0.0, 0.0, 0.0, 1.0])


def node_name(number: int, node: dict[str, Any]) -> str:
    return str(node.get("name") or f"node {number}")


def note_rotations(tree: dict[str, Any], unread: UnreadLog) -> None:
    """Note the rotations that are no unit quaternions."""
    for number, node in enumerate(tree.get("nodes", [])):
        length = float(np.linalg.norm(node.get("rotation", (0.0, 0.0, 0.0, 1.0))))
        if not abs(length - 1.0) <= ROUNDED:
            instead = "divided by it" if 0.0 < length < math.inf else "left out"
            unread.note(f"rotation of node {node_name(number, node)[:60]!r} of length {length:.3g}", instead)


def lights(tree: dict[str, Any], context: LoadContext) -> list[Light]:
    """Return the lights of KHR_lights_punctual at visible nodes, in float64, and note those that cannot be read. Scales of
    nodes change their positions and nothing else."""
    found = []
    for at in placed(tree):
        reference = at.node.get("extensions", {}).get(PUNCTUAL)
        if reference is not None and at.visible:
            name = at.name
            try:
                with explained(tree):
                    light = entry(tree.get("extensions", {}).get(PUNCTUAL, {}), "lights", reference["light"])
                    name = str(light.get("name") or name)
                    found.append(_light(light, at.world, context))
            except (FormatError, TypeError, ValueError, KeyError) as error:
                context.unread.note(f"light {name[:60]!r}", f"left out: {error}")
                continue
            if "range" in light:
                context.unread.note("range of lights", INSTEAD_OF_RANGE)
    return found


def _light(given: dict[str, Any], world: np.ndarray, context: LoadContext) -> Light:
    position, direction = (torch.tensor(v, dtype=torch.float64) for v in (world[:3, 3], -world[:3, 2]))
    intensity = float(given.get("intensity", 1.0))
    color = torch.tensor([float(c) for c in given.get("color", (1.0, 1.0, 1.0))], dtype=torch.float64)
    kind = given.get("type")
    if kind == "directional":
        return DirectionalLight(direction, intensity, color)
    if kind == "point":
        return PointLight(position, intensity, color)
    if kind == "spot":
        return SpotLight(position, direction, intensity, color, *_cone(given, context))
    raise FormatError(f"expected a light of type directional, point or spot, got {kind!r}; export it again")


def _cone(light: dict[str, Any], context: LoadContext) -> tuple[float, float]:
    """Return the inner and outer angle of a spot light. Where they are not 0 ≤ inner < outer ≤ π/2, as the extension requires,
    they become so: the cosines differ by 0.001 at least, as in the formula of its text."""
    given = light.get("spot", {})
    inner, outer = float(given.get("innerConeAngle", 0.0)), float(given.get("outerConeAngle", math.pi / 4))
    if 0.0 <= inner < outer <= math.pi / 2 or not 0.0 < outer < math.inf or not math.isfinite(inner):
        return inner, outer  # what is no angle at all, SpotLight refuses
    end = min(outer, math.pi / 2)
    start = min(max(inner, 0.0), math.acos(min(math.cos(end) + 1e-3, 1.0)))
    name = str(light.get("name", "without a name"))[:60]
    context.unread.note(
        f"spot light {name!r} with innerConeAngle {inner:.6g} and outerConeAngle {outer:.6g}",
        f"shown with {start:.6g} and {end:.6g}",
    )
    return start, end


def cameras(tree: dict[str, Any], size: tuple[int, int]) -> dict[str, Camera | FormatError]:
    """Return cameras in float64 by the names of their nodes, in order; a FormatError stands in place of one that cannot be
    read. The size (H, W) is in square pixels: of aspectRatio, yfov and ymag the latter two give the height. Raises ValueError
    about it."""
    found: dict[str, Camera | FormatError] = {}
    for at in placed(tree):  # also where nothing else of it is visible
        if "camera" not in at.node:
            continue
        name = str(at.node.get("name") or f"camera {len(found)}")
        name = unique_name(found, name, f"{name} ({len(found)})")
        try:
            with explained(tree):
                found[name] = _camera(entry(tree, "cameras", at.node["camera"]), at.world, size)
        except (FormatError, TypeError, ValueError, KeyError) as error:
            found[name] = FormatError(str(error))
    return found


def _camera(given: dict[str, Any], world: np.ndarray, size: tuple[int, int]) -> Camera:
    if np.linalg.det(world[:3, :3]) < 0.0:
        raise FormatError(
            "expected a camera that turns and shifts, got one below a node that mirrors; export it without mirroring"
        )
    length = np.linalg.norm(world[:3, :3], axis=0)  # a camera has no scale
    pose = torch.tensor(world, dtype=torch.float64)
    pose[:3, :3] /= torch.tensor(np.where(length > 0.0, length, 1.0))
    kind = given.get("type")
    if kind == "perspective":
        return Camera.from_opengl(pose, size, math.degrees(given["perspective"]["yfov"]))
    if kind == "orthographic":
        scale = size[0] / (2.0 * given["orthographic"]["ymag"])
        K = pose.new_tensor([[scale, 0.0, size[1] / 2], [0.0, scale, size[0] / 2], [0.0, 0.0, 1.0]])
        return dataclasses.replace(Camera.from_opengl(pose, size, K=K), projection="orthographic")
    raise FormatError(f"expected a camera of type perspective or orthographic, got {kind!r}; export it again")
