"""Lights and cameras at the nodes of glTF files."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from ...camera.camera import Camera
from ...optional import require
from ...scene.lights import DirectionalLight, Light, PointLight, SpotLight
from .part import Fault
from .source import Source

PUNCTUAL = "KHR_lights_punctual"
INSTEAD_OF_RANGE = "light falls off with the square of the distance, without an end"


def placed(tree: dict[str, Any]) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The nodes of the scene with their matrices (4, 4) to the world. Raises Fault where they are no tree."""
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    waiting = [(root, np.eye(4)) for root in scenes[tree.get("scene", 0)].get("nodes", [])] if scenes else []
    seen: set[int] = set()
    while waiting:
        index, above = waiting.pop(0)
        if index in seen:
            raise Fault("expected a tree of nodes, got some inside two others; export it again")
        seen.add(index)
        world = above @ _matrix(nodes[index])
        yield nodes[index], world
        waiting[:0] = [(child, world) for child in nodes[index].get("children", [])]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) of a node within the one above it: the product of shift, rotation and scaling."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    transformations = require("trimesh.transformations", "trimesh", "reading meshes")
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    shift = transformations.translation_matrix(node.get("translation", (0.0, 0.0, 0.0)))
    scale = np.diag((*node.get("scale", (1.0, 1.0, 1.0)), 1.0))
    return shift @ transformations.quaternion_matrix((w, x, y, z)) @ scale


def lights(tree: dict[str, Any], source: Source) -> list[Light]:
    """Those of KHR_lights_punctual. Scales of nodes change where they are, and nothing else of them. Raises Fault."""
    given = tree.get("extensions", {}).get(PUNCTUAL, {}).get("lights", [])
    found = []
    for node, world in placed(tree):
        reference = node.get("extensions", {}).get(PUNCTUAL)
        if reference is not None:
            light = given[reference["light"]]
            try:
                found.append(_light(light, world))
            except (TypeError, ValueError) as error:
                raise Fault(f"light {str(light.get('name', reference['light']))[:60]!r}: {error}") from error
            if "range" in light:
                source.unsupported.note("range of lights", INSTEAD_OF_RANGE)
    return found


def _light(given: dict[str, Any], world: np.ndarray) -> Light:
    position, direction = (torch.tensor(v, dtype=torch.float32) for v in (world[:3, 3], -world[:3, 2]))
    intensity = float(given.get("intensity", 1.0))
    color = torch.tensor([float(c) for c in given["color"]]) if "color" in given else torch.ones(3)
    kind, cone = given.get("type"), given.get("spot", {})
    if kind == "directional":
        return DirectionalLight(direction, intensity, color)
    if kind == "point":
        return PointLight(position, intensity, color)
    if kind == "spot":
        inner, outer = float(cone.get("innerConeAngle", 0.0)), float(cone.get("outerConeAngle", math.pi / 4))
        return SpotLight(position, direction, intensity, color, inner, outer)
    raise Fault(f"expected a light of type directional, point or spot, got {kind!r}; export it again")


def cameras(tree: dict[str, Any], size: tuple[int, int], dtype: torch.dtype) -> dict[str, Camera]:
    """By the names of their nodes and in their order, (H, W) pixels, which are square: of aspectRatio, yfov and ymag these give
    the height. Raises Fault, or ValueError about the size."""
    found: dict[str, Camera] = {}
    for node, world in placed(tree):
        if "camera" not in node:
            continue
        name = str(node.get("name", f"camera {len(found)}"))
        name = f"{name} ({len(found)})" if name in found else name
        given = tree["cameras"][node["camera"]]
        length = np.linalg.norm(world[:3, :3], axis=0)  # a camera has no scale
        pose = torch.tensor(world, dtype=dtype)
        pose[:3, :3] /= torch.tensor(np.where(length > 0.0, length, 1.0))
        kind = given.get("type")
        if kind == "perspective":
            found[name] = Camera.from_opengl(pose, size, math.degrees(given["perspective"]["yfov"]))
        elif kind == "orthographic":
            scale = size[0] / (2.0 * given["orthographic"]["ymag"])
            K = [[scale, 0.0, size[1] / 2], [0.0, scale, size[0] / 2], [0.0, 0.0, 1.0]]
            found[name] = dataclasses.replace(Camera.from_opengl(pose, size, K=K), projection="orthographic")
        else:
            raise Fault(f"expected a camera of type perspective or orthographic, got {kind!r}; export it again")
    return found
