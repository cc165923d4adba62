"""Meshes with their materials, lights and cameras as glTF and GLB files.

trimesh packs arrays and images. What it drops or rounds is added to the JSON before writing: factors in full, samplers, several
sets of texture coordinates, the strength of emission, the scale of normal maps, lights and cameras. What several meshes share
is written once.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...camera.camera import Camera
from ...optional import require
from ...scene.lights import DirectionalLight, Light, PointLight, SpotLight
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from .gltf import PUNCTUAL
from .gltf_write import GltfAppearance, split


def to_glb(mesh: Mesh) -> tuple[bytes, list[str]]:
    """Return the file, and the names of what it does not hold of the mesh. Raises ImportError without trimesh, or pillow for
    textures."""
    return _packed([mesh], [], {}, "glb", unlit=False)


def scene_to_gltf(scene: Scene, cameras: Mapping[str, Camera], kind: str) -> tuple[bytes, list[str]]:
    """Return a "glb", or a "gltf" that embeds its arrays and images, and what it does not hold of the scene and cameras. Raises
    ImportError as to_glb() does."""
    content, lost = _packed(scene.meshes, [light for light in scene.lights if isinstance(light, Light)], cameras, kind)
    return content, [*lost, *(["background"] if scene.background is not None else [])]


def _packed(
    meshes: Sequence[Mesh], lights: Sequence[Light], cameras: Mapping[str, Camera], kind: str, unlit: bool = True
) -> tuple[bytes, list[str]]:
    trimesh = require("trimesh", "trimesh", "saving meshes")
    gltf = require("trimesh.exchange.gltf", "trimesh", "saving meshes")
    appearances = [GltfAppearance(mesh, unlit) for mesh in meshes]
    parts = {}
    for k, appearance in enumerate(appearances):
        verts, faces, attributes = split(appearance)
        made = trimesh.Trimesh(verts, faces, process=False, vertex_attributes=attributes)
        if appearance.material:
            images = {name: _picture(image) for name, image in appearance.images.items()}
            # Names differ, because trimesh joins materials with the same images.
            material = trimesh.visual.material.PBRMaterial(name=f"material {k}", **images)
            made.visual = trimesh.visual.TextureVisuals(material=material)
        parts[str(k)] = made
    lost = [
        f"{what}{_which(k, len(appearances))}" for k, appearance in enumerate(appearances) for what in appearance.lost
    ]

    def write(tree: dict[str, Any]) -> None:
        for mesh in tree["meshes"]:
            number = int(mesh["name"])
            mesh["name"] = meshes[number].name or f"geometry_{number}"
            appearances[number].write(tree, mesh["primitives"][0])
        for node in tree["nodes"]:
            if "mesh" in node:
                node["name"] = tree["meshes"][node["mesh"]]["name"]
        _share(tree)
        lost.extend(_place(tree, lights, cameras, meshes))
        used = {name for material in tree.get("materials", []) for name in material.get("extensions", {})}
        if used := sorted({*tree.get("extensionsUsed", []), *tree.get("extensions", {}), *used}):
            tree["extensionsUsed"] = used

    options = {"include_normals": False, "tree_postprocessor": write}
    if kind == "glb":
        return gltf.export_glb(trimesh.Scene(parts), **options), lost
    files = gltf.export_gltf(trimesh.Scene(parts), merge_buffers=True, embed_buffers=True, **options)
    return files["model.gltf"], lost


def _which(k: int, count: int) -> str:
    return f" of meshes[{k}]" if count > 1 else ""


def _picture(image: np.ndarray) -> Any:
    return require("PIL.Image", "edgegrad[files]", "saving textures").fromarray(image)


def _share(tree: dict[str, Any]) -> None:
    images, samplers = (_unique(tree, name) for name in ("images", "samplers"))
    for texture in tree.get("textures", []):
        texture["source"] = images[texture["source"]]
        if "sampler" in texture:
            texture["sampler"] = samplers[texture["sampler"]]
    textures = _unique(tree, "textures")
    for material in tree.get("materials", []):
        for given in (material, material.get("pbrMetallicRoughness", {})):
            for name, reference in given.items():
                if name.endswith("Texture"):
                    reference["index"] = textures[reference["index"]]
    materials = _unique(tree, "materials")
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            if "material" in primitive:
                primitive["material"] = materials[primitive["material"]]


def _unique(tree: dict[str, Any], name: str) -> list[int]:
    """Keep one of each in a list of the file, and return the new number of each old one."""
    kept: dict[str, int] = {}
    numbers = [kept.setdefault(json.dumps(entry, sort_keys=True), len(kept)) for entry in tree.get(name, [])]
    if kept:
        tree[name] = [json.loads(entry) for entry in kept]
    return numbers


def _place(
    tree: dict[str, Any], lights: Sequence[Light], cameras: Mapping[str, Camera], meshes: Sequence[Mesh]
) -> list[str]:
    """Add the nodes of lights and cameras, and return the names of those that cannot be there."""
    lost: list[str] = []
    nodes: list[dict[str, Any]] = []
    written: list[dict[str, Any]] = []
    for k, light in enumerate(lights):
        name = f"{type(light).__name__} (lights[{k}])"
        made, missing = light_of(light)
        lost += [f"{what} of {name}" for what in missing]
        if made is None:
            lost.append(name)
        else:
            nodes.append(node_of(place_of(light), extensions={PUNCTUAL: {"light": len(written)}}))
            written.append(made)
    if written:
        tree.setdefault("extensions", {})[PUNCTUAL] = {"lights": written}
    for name, camera in cameras.items():
        found = camera_of(camera, meshes)
        if isinstance(found, str):
            lost.append(f"camera {name!r} ({found})")
        else:
            tree.setdefault("cameras", []).append(found[0])
            nodes.append(node_of(found[1], name=name, camera=len(tree["cameras"]) - 1))
    first = len(tree["nodes"])
    tree["nodes"] += nodes
    tree["scenes"][0]["nodes"] = [*tree["scenes"][0]["nodes"], *range(first, len(tree["nodes"]))]
    return lost


KINDS: dict[type[Light], str] = {DirectionalLight: "directional", PointLight: "point", SpotLight: "spot"}
ROUNDING = 1e-6  # of a camera's size: numbers that differ by so little are rounded
# Other programs look between these planes of a camera, in extents of what it sees.
NEAR_PLANE, FAR_PLANE = 1e-3, 10.0


def light_of(light: Light) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the light's entry in KHR_lights_punctual, or None where glTF has no such light; and what the entry does not hold
    of it."""
    kind = KINDS.get(type(light))
    if kind is None:
        return None, []
    assert isinstance(light, DirectionalLight | PointLight | SpotLight)
    lost = []
    intensity = float(torch.as_tensor(light.intensity))
    color = torch.ones(3, dtype=torch.float64) if light.color is None else _double(light.color).expand(3)
    if intensity < 0.0 or bool((color < 0).any()):
        lost.append("what takes light away")
        intensity, color = max(intensity, 0.0), color.clamp(min=0.0)
    brightest = max(1.0, float(color.max()))  # a colour goes up to 1
    made: dict[str, Any] = {"type": kind, "intensity": intensity * brightest, "color": (color / brightest).tolist()}
    if isinstance(light, SpotLight):
        inner, outer = (float(torch.as_tensor(angle)) for angle in (light.inner_angle, light.outer_angle))
        outer = min(outer, math.pi / 2)
        made["spot"] = {"innerConeAngle": inner, "outerConeAngle": outer}
    return made, lost


def place_of(light: Light) -> np.ndarray:
    """Return the matrix (4, 4) to the world of the node at which the light stands, which shines along −Z."""
    world = np.eye(4)
    if isinstance(light, DirectionalLight | SpotLight):
        back = -_double(light.direction).numpy()
        back = back / np.abs(back).max()
        back = back / np.linalg.norm(back)
        across = np.cross(np.eye(3)[np.abs(back).argmin()], back)
        across = across / np.linalg.norm(across)
        world[:3, :3] = np.stack([across, np.cross(back, across), back], 1)
    if isinstance(light, PointLight | SpotLight):
        world[:3, 3] = _double(light.position).numpy()
    return world


def camera_of(camera: Camera, meshes: Sequence[Mesh]) -> tuple[dict[str, Any], np.ndarray] | str:
    """Return the camera's entry and its place in the world, looking along −Z with +Y up; or why glTF has no such camera."""
    H, W = camera.size
    K, pose = _double(camera.K), _double(camera.world_to_camera)
    if camera.projection not in ("perspective", "orthographic") or camera.distortion is not None:
        return "its lens"
    scale = float(K[1, 1])
    middle = torch.tensor([W / 2, H / 2], dtype=torch.float64)
    if float((K[:2, 2] - middle).abs().max()) > ROUNDING * max(H, W):
        return "its principal point is off the middle"
    if abs(float(K[0, 0]) - scale) > ROUNDING * scale or abs(float(K[0, 1])) > ROUNDING * scale:
        return "its pixels are not square"
    world = np.linalg.inv(pose.numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's y down and z forward
    verts = torch.cat([_double(mesh.verts) for mesh in meshes])
    depth = verts @ pose[2, :3] + pose[2, 3]
    extent = float((verts.amax(0) - verts.amin(0)).norm())
    near, far = NEAR_PLANE * extent, float(depth.max().clamp(min=0.0)) + FAR_PLANE * extent
    if camera.projection == "perspective":
        made = {"yfov": 2.0 * math.atan(H / (2.0 * scale)), "aspectRatio": W / H, "znear": near, "zfar": far}
        return {"type": "perspective", "perspective": made}, world
    made = {"xmag": W / (2.0 * scale), "ymag": H / (2.0 * scale), "znear": 0.0, "zfar": far}
    return {"type": "orthographic", "orthographic": made}, world


def node_of(world: np.ndarray, **fields: Any) -> dict[str, Any]:
    return {"matrix": world.T.reshape(-1).tolist(), **fields}


def _double(value: Tensor) -> Tensor:
    return value.detach().cpu().double()
