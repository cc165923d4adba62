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
from .gltf import PUNCTUAL, VISIBILITY, entry
from .part import Fault
from .source import Source

INSTEAD_OF_RANGE = "light falls off with the square of the distance, without an end"


class Placed(NamedTuple):
    """A node of the scene in its place."""

    number: int  # in the file's list of nodes
    above: int | None  # the node that it is within
    node: dict[str, Any]
    world: np.ndarray  # (4, 4), to the world
    visible: bool  # it and all nodes above it (KHR_node_visibility)

    @property
    def of_mesh(self) -> np.ndarray:
        """(4, 4) of the node's mesh: one with a skin stands where its joints do (glTF 2.0, section 3.7.3.3)."""
        return np.eye(4) if "skin" in self.node else self.world


def placed(tree: dict[str, Any]) -> Iterator[Placed]:
    """The nodes of the scene, each before those below it; without scenes, of all nodes. Raises Fault where they are no tree."""
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
            raise Fault(
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
        raise Fault(f"expected true or false for visible of {VISIBILITY}, got {visible!r}; export it again")
    return visible


def matrix_of(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) of a node within the one above it: the product of shift, rotation and scaling."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    transformations = require("trimesh.transformations", "trimesh", "reading meshes")
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    shift = transformations.translation_matrix(node.get("translation", (0.0, 0.0, 0.0)))
    scale = np.diag((*node.get("scale", (1.0, 1.0, 1.0)), 1.0))
    return shift @ transformations.quaternion_matrix((w, x, y, z)) @ scale


def lights(tree: dict[str, Any], source: Source) -> list[Light]:
    """Those of KHR_lights_punctual at visible nodes, in float64. Scales of nodes change where they are, and nothing else
    of them. Raises Fault."""
    found = []
    for _, _, node, world, visible in placed(tree):
        reference = node.get("extensions", {}).get(PUNCTUAL)
        if reference is not None and visible:
            light = entry(tree.get("extensions", {}).get(PUNCTUAL, {}), "lights", reference["light"])
            try:
                found.append(_light(light, world, source))
            except (TypeError, ValueError) as error:
                raise Fault(f"light {str(light.get('name', reference['light']))[:60]!r}: {error}") from error
            if "range" in light:
                source.unsupported.note("range of lights", INSTEAD_OF_RANGE)
    return found


def _light(given: dict[str, Any], world: np.ndarray, source: Source) -> Light:
    position, direction = (torch.tensor(v, dtype=torch.float64) for v in (world[:3, 3], -world[:3, 2]))
    intensity = float(given.get("intensity", 1.0))
    color = torch.tensor([float(c) for c in given.get("color", (1.0, 1.0, 1.0))], dtype=torch.float64)
    kind = given.get("type")
    if kind == "directional":
        return DirectionalLight(direction, intensity, color)
    if kind == "point":
        return PointLight(position, intensity, color)
    if kind == "spot":
        return SpotLight(position, direction, intensity, color, *_cone(given, source))
    raise Fault(f"expected a light of type directional, point or spot, got {kind!r}; export it again")


def _cone(light: dict[str, Any], source: Source) -> tuple[float, float]:
    """The inner and outer angle of a spot light. Where they are not 0 ≤ inner < outer ≤ π/2, as the extension wants them, they
    become so: the cosines differ by 0.001 at least, as in the formula of its text."""
    given = light.get("spot", {})
    inner, outer = float(given.get("innerConeAngle", 0.0)), float(given.get("outerConeAngle", math.pi / 4))
    if 0.0 <= inner < outer <= math.pi / 2 or not 0.0 < outer < math.inf or not math.isfinite(inner):
        return inner, outer  # what is no angle at all, SpotLight refuses
    end = min(outer, math.pi / 2)
    start = min(max(inner, 0.0), math.acos(min(math.cos(end) + 1e-3, 1.0)))
    name = str(light.get("name", "without a name"))[:60]
    source.unsupported.note(
        f"spot light {name!r} with innerConeAngle {inner:.6g} and outerConeAngle {outer:.6g}",
        f"shown with {start:.6g} and {end:.6g}",
    )
    return start, end


def cameras(tree: dict[str, Any], size: tuple[int, int]) -> dict[str, Camera]:
    """In float64, by the names of their nodes and in their order, (H, W) pixels, which are square: of aspectRatio, yfov and
    ymag these give the height. Raises Fault, or ValueError about the size."""
    found: dict[str, Camera] = {}
    for _, _, node, world, _ in placed(tree):  # also where nothing else of it is visible
        if "camera" not in node:
            continue
        name = str(node.get("name", f"camera {len(found)}"))
        name = f"{name} ({len(found)})" if name in found else name
        given = entry(tree, "cameras", node["camera"])
        length = np.linalg.norm(world[:3, :3], axis=0)  # a camera has no scale
        pose = torch.tensor(world, dtype=torch.float64)
        pose[:3, :3] /= torch.tensor(np.where(length > 0.0, length, 1.0))
        kind = given.get("type")
        if kind == "perspective":
            found[name] = Camera.from_opengl(pose, size, math.degrees(given["perspective"]["yfov"]))
        elif kind == "orthographic":
            scale = size[0] / (2.0 * given["orthographic"]["ymag"])
            K = pose.new_tensor([[scale, 0.0, size[1] / 2], [0.0, scale, size[0] / 2], [0.0, 0.0, 1.0]])
            found[name] = dataclasses.replace(Camera.from_opengl(pose, size, K=K), projection="orthographic")
        else:
            raise Fault(f"expected a camera of type perspective or orthographic, got {kind!r}; export it again")
    return found
