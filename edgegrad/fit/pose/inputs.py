"""Inputs of pose searches: pictures with their cameras, and whether these see the object at the start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...warnings import warn
from ..placement import Pose
from ..region import VISIBLE
from .settings import CAMERA, POSE


class ArgumentNames(NamedTuple):
    """The names of a function's arguments, for error messages."""

    mesh: str = "mesh"
    images: str = "images"
    init: str = "init"
    masks: str = "masks"


def without_colors(scene: Mesh | Scene) -> Scene:
    """Return the shapes alone."""
    meshes: Sequence[Mesh] = [scene] if isinstance(scene, Mesh) else scene.meshes
    return Scene([Mesh(mesh.verts, mesh.faces) for mesh in meshes])


def check_in_front(name: str, camera: Camera, pose: Pose, center: Tensor) -> None:
    """Raise ValueError where the object's centre is behind a perspective camera."""
    depth = float(depth_of(camera, pose, center))
    if camera.projection == "perspective" and depth <= 0.0:
        raise ValueError(f"{name}: expected the object in front of the camera, got its centre at depth {depth:.3g}")


def check_seen(name: str, scene: Scene, cameras: Sequence[Camera], pose: Pose) -> None:
    """Raise ValueError where no camera sees the object."""
    moved = scene.transformed(pose.R, pose.t, pose.scale)
    with torch.no_grad():
        covered = sum(
            float(render_aovs(without_colors(moved), camera, ["alpha"], CAMERA.check_spp, 0)["alpha"].sum())
            for camera in cameras
        )
    if covered < VISIBLE:
        raise ValueError(
            f"{name}: expected a pose at which the camera sees the mesh, got one out of the picture; start where it is"
        )


def depth_of(camera: Camera, pose: Pose, point: Tensor) -> Tensor:
    """Return the depth of a point of the mesh along the camera's axis."""
    view = camera.world_to_camera.double()
    return (view[:3, :3] @ (pose.matrix[:3, :3] @ point + pose.t) + view[:3, 3])[2]


def warn_of_units(scene: Scene, cameras: Sequence[Camera], depths: Sequence[Tensor | None], where: str) -> None:
    """Warn where depth images (H, W), NaN without a measurement, have units other than the scene's, with its meshes where they
    are expected. The depth term would reject all such measurements."""
    measured, expected = [], []
    for camera, depth in zip(cameras, depths, strict=True):
        if depth is None:
            continue
        with torch.no_grad():
            seen = render_aovs(without_colors(scene), camera, ["depth", "alpha"], CAMERA.check_spp, 0)
        alpha = seen["alpha"][..., 0]
        inside = (alpha > 0.5) & depth.isfinite()
        measured.append(depth[inside].double())
        expected.append((seen["depth"][..., 0] / alpha.clamp(min=0.5))[inside].double())
    if sum(map(len, measured)) < POSE.min_depth_pixels:
        return
    there, here = (float(torch.cat(values).median()) for values in (measured, expected))
    ratio = here / there
    if not 1.0 / CAMERA.unit_factor < ratio < CAMERA.unit_factor:
        power = round(math.log10(ratio))
        scale = 10.0**power if abs(math.log10(ratio) - power) < 0.15 else ratio
        warn(
            f"units of depth {scale:.2g}",
            f"depths: expected distances in world units, those of the mesh and the camera, got {there:.3g} in the middle where "
            f"the object is {where}, {here:.3g} away; so depth counts for nothing. If its units are others, multiply it by "
            f"{scale:.2g}",
        )
