"""Lights and cameras in the terms of glTF, which gltf_nodes.py reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...camera.camera import Camera
from ...scene.lights import DirectionalLight, Light, PointLight, SpotLight
from ...scene.mesh import Mesh

KINDS: dict[type[Light], str] = {DirectionalLight: "directional", PointLight: "point", SpotLight: "spot"}
SAME = 1e-6  # of a camera's size: numbers that differ by so little are rounded
NEAR, FAR = 1e-3, 10.0  # the planes of a camera between which other programs look, in extents of what it sees


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
    if float((K[:2, 2] - middle).abs().max()) > SAME * max(H, W):
        return "its principal point is off the middle"
    if abs(float(K[0, 0]) - scale) > SAME * scale or abs(float(K[0, 1])) > SAME * scale:
        return "its pixels are not square"
    world = np.linalg.inv(pose.numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's y down and z forward
    verts = torch.cat([_double(mesh.verts) for mesh in meshes])
    depth = verts @ pose[2, :3] + pose[2, 3]
    extent = float((verts.amax(0) - verts.amin(0)).norm())
    near, far = NEAR * extent, float(depth.max().clamp(min=0.0)) + FAR * extent
    if camera.projection == "perspective":
        made = {"yfov": 2.0 * math.atan(H / (2.0 * scale)), "aspectRatio": W / H, "znear": near, "zfar": far}
        return {"type": "perspective", "perspective": made}, world
    made = {"xmag": W / (2.0 * scale), "ymag": H / (2.0 * scale), "znear": 0.0, "zfar": far}
    return {"type": "orthographic", "orthographic": made}, world


def node_of(world: np.ndarray, **fields: Any) -> dict[str, Any]:
    return {"matrix": world.T.reshape(-1).tolist(), **fields}


def _double(value: Tensor) -> Tensor:
    return value.detach().cpu().double()
