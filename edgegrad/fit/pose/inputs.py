"""Inputs of pose searches: pictures with their cameras, and whether these see the object at the start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...check import check_int, check_positive_int, shape_text
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...warnings import warn
from ..region import VISIBLE
from .pose import Pose

CHECK_SPP = 4  # samples a pixel
MIN_PICTURE_SIDE = 8  # Pixels on the shorter side of a picture: fewer show no contour.


class ArgumentNames(NamedTuple):
    """The names of a function's arguments, for error messages."""

    mesh: str = "mesh"
    target: str = "target"
    init: str = "init"
    lens: tuple[str, ...] = ("fit_scale", "fit_focal")  # entries of Unknowns
    mask: str = "mask"


def shots_of(
    camera: Any, target: Any, mask: Any, weight: Any, names: ArgumentNames
) -> list[tuple[str, Camera, Any, Any, Any]]:
    """Return the suffix of the arguments' names, camera, picture, mask and weight of each view. Raises TypeError or
    ValueError."""
    several = isinstance(camera, Sequence) and not isinstance(camera, str)
    cameras: list[Any] = list(camera) if several else [camera]
    if not cameras:
        raise ValueError("camera: expected at least one, got none")
    columns = []
    for name, value, needed in ((names.target, target, True), (names.mask, mask, False), ("weight", weight, False)):
        if value is None and not needed:
            columns.append([None] * len(cameras))
        elif not several:
            if isinstance(value, Sequence) and any(hasattr(one, "shape") for one in value):
                raise ValueError(
                    f"{name}: expected one, for the one camera, got a list of {len(value)}; give a list of cameras too"
                )
            columns.append([value])
        else:
            columns.append(one_for_each(name, value, len(cameras), 3 if needed else 2))
    for i, one in enumerate(cameras):
        if not isinstance(one, Camera):
            raise TypeError(f"camera: expected a Camera, got {type(one).__name__}; make one with Camera.look_at(…)")
        if one.batch is not None:
            raise ValueError(f"camera: expected one camera, got {one.batch}; give a list of cameras, and of pictures")
        if one.world_to_camera.dtype != one.K.dtype:
            cameras[i] = one.to(torch.float64)
    suffixes = [f"[{i}]" for i in range(len(cameras))] if several else [""]
    return list(zip(suffixes, cameras, *columns, strict=True))


def one_for_each(name: str, given: Any, count: int, dims: int) -> list[Any]:
    """Return one image for each camera, from a list or from an array with one more dimension. Raises ValueError."""
    shape = getattr(given, "shape", None)
    if shape is not None and (len(shape) <= dims or (len(shape) == 3 and shape[-1] == 1 and len(given) != count)):
        if count == 1:
            return [given]
        raise ValueError(
            f"{name}: expected {count}, one for each camera, got one of shape {shape_text(shape)}; give a list of them"
        )
    if not isinstance(given, Sequence) and shape is None:
        raise ValueError(f"{name}: expected a list of {count}, one for each camera, got {type(given).__name__}")
    if len(given) != count:
        raise ValueError(f"{name}: expected {count}, one for each camera, got {len(given)}")
    return list(given)


def without_colors(scene: Mesh | Scene) -> Scene:
    """Return the shapes alone."""
    meshes: Sequence[Mesh] = [scene] if isinstance(scene, Mesh) else scene.meshes
    return Scene([Mesh(mesh.verts, mesh.faces) for mesh in meshes])


def check_max_size(max_size: object) -> None:
    """Raise TypeError or ValueError for a `max_size` that is too small."""
    check_int("max_size", max_size, MIN_PICTURE_SIDE, 2**31 - 1)


def check_settings(max_size: object, steps: object, spp: object, seed: object, tolerance: object) -> None:
    """Raise TypeError or ValueError for settings that no search can have."""
    check_max_size(max_size)
    for name, count in (("steps", steps), ("spp", spp)):
        check_positive_int(name, count)
    check_int("seed", seed, 0, 2**32 - 1)
    if not isinstance(tolerance, (int, float)) or isinstance(tolerance, bool):
        raise TypeError(f"tolerance: expected a number, got {type(tolerance).__name__} ({tolerance!r})")
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance: expected a number above 0 and below 1, got {tolerance:g}")


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
            float(render_aovs(without_colors(moved), camera, ["alpha"], CHECK_SPP, 0)["alpha"].sum())
            for camera in cameras
        )
    if covered < VISIBLE:
        raise ValueError(
            f"{name}: expected a pose at which the camera sees the mesh, got one out of the picture; start where it is"
        )


def warn_of_scale(name: str, scene: Scene, camera: Camera) -> None:
    """Warn where a placed mesh has units other than its camera's, so that it is hardly visible."""
    verts = torch.cat([mesh.verts.double() for mesh in scene.meshes])
    low, high = verts.aminmax(dim=0)
    view = camera.world_to_camera.double()
    eye = -(view[:3, :3].T @ view[:3, 3])
    size, away = float((high - low).norm()), float((0.5 * (low + high) - eye).norm())
    where = f"it is {size:.3g} across, and its middle is {away:.3g} from the camera"
    fix = "do both have the same units? Mesh.transformed(scale=…) changes those of the mesh"
    if camera.projection == "perspective" and bool(((low < eye) & (eye < high)).all()):
        warn(f"inside {name}", f"{name}: the camera stands inside the mesh: {where}; {fix}")
    seen = camera.project(verts)
    if not bool(seen.isfinite().all()):
        return
    across = float((seen.amax(0) - seen.amin(0)).max())
    if across < 1.0:
        warn(f"far {name}", f"{name}: the mesh covers {across:.2g} px: {where}; {fix}")


def depth_of(camera: Camera, pose: Pose, point: Tensor) -> Tensor:
    """Return the depth of a point of the mesh along the camera's axis."""
    view = camera.world_to_camera.double()
    return (view[:3, :3] @ (pose.matrix[:3, :3] @ point + pose.t) + view[:3, 3])[2]
