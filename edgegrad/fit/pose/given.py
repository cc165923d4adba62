"""What a search for poses is given: pictures and their cameras, and whether they see the object where it starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...check import check_int, shape_text
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...warnings import warn
from ..region import VISIBLE
from .pose import Pose

SAMPLES = 4  # a pixel, of a look whether the object is there
LEAST = 8  # pixels on the shorter side of a picture: fewer show no contour


class Names(NamedTuple):
    """What a function calls its arguments, for errors."""

    mesh: str = "mesh"
    target: str = "target"
    init: str = "init"
    lens: tuple[str, ...] = ("fit_scale", "fit_focal")  # of the entries of a Lens
    mask: str = "mask"


def shots_of(camera: Any, target: Any, mask: Any, weight: Any, names: Names) -> list[tuple[str, Camera, Any, Any, Any]]:
    """Suffix of the arguments' names, camera, picture, mask and weight of each view. Raises TypeError or ValueError."""
    several = isinstance(camera, Sequence) and not isinstance(camera, str)
    cameras: list[Any] = list(camera) if several else [camera]
    if not cameras:
        raise ValueError("camera: expected at least one, got none")
    columns = []
    of_masks = (names.mask, "weight")  # images without channels
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
            columns.append(one_for_each(name, value, len(cameras), 2 if name in of_masks else 3))
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
    """Of each camera: from a list, or from an array with one more dimension than an image has. One image is that of the only
    camera. Raises ValueError."""
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


def bare(scene: Mesh | Scene) -> Scene:
    """Shapes alone."""
    meshes: Sequence[Mesh] = [scene] if isinstance(scene, Mesh) else scene.meshes
    return Scene([Mesh(mesh.verts, mesh.faces) for mesh in meshes])


def check_max_size(max_size: object) -> None:
    """Raises TypeError or ValueError."""
    check_int("max_size", max_size, LEAST, 2**31 - 1)


def check_in_front(name: str, camera: Camera, pose: Pose, center: Tensor) -> None:
    """Raises ValueError where the object's centre is behind a camera that does not see all around."""
    depth = float(depth_of(camera, pose, center))
    if camera.projection == "perspective" and depth <= 0.0:
        raise ValueError(f"{name}: expected the object in front of the camera, got its centre at depth {depth:.3g}")


def check_seen(name: str, scene: Scene, cameras: Sequence[Camera], pose: Pose) -> None:
    """Raises ValueError where no camera sees the object."""
    moved = scene.transformed(pose.R, pose.t, pose.scale)
    with torch.no_grad():
        covered = sum(float(render_aovs(bare(moved), camera, ["alpha"], SAMPLES)["alpha"].sum()) for camera in cameras)
    if covered < VISIBLE:
        raise ValueError(
            f"{name}: expected a pose at which the camera sees the mesh, got one out of the picture; start where it is"
        )


def warn_of_scale(name: str, scene: Scene, camera: Camera) -> None:
    """Warn where a mesh, as it is placed, has other units than its camera, by which it is hardly to be seen."""
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
    """Of a point of the mesh, along the camera's axis."""
    view = camera.world_to_camera.double()
    return (view[:3, :3] @ (pose.matrix[:3, :3] @ point + pose.t) + view[:3, 3])[2]
