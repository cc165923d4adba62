"""Build a scene and its cameras from the values of parameters."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.poses import rigid
from ...check import as_tensor, check_shape
from ...optim.parameter import Parameter
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.tree import map_tensors, named_tensors, with_named
from ..placement import Placement, Pose, PoseParameter

Values = dict[str, Any]  # tensors, and poses
Built = tuple[Scene, list[Camera]]
Build = Callable[[Values], Built]


class SceneTensors:
    """The tensors of a scene and its cameras by name, and the objects that may get a pose by the pose's name."""

    def __init__(self, start: Scene | Mesh, cameras: list[Camera]) -> None:
        found = dict(named_tensors(start)) | {f"cameras.{name}": tensor for name, tensor in named_tensors(cameras)}
        found = {name: tensor for name, tensor in found.items() if tensor.is_floating_point()}
        # Numbers of a matrix that move apart from one another are soon no rotation.
        fixed = [name for name in found if name.startswith("cameras.") and name.endswith(".world_to_camera")]
        self.tensors = {name: tensor for name, tensor in found.items() if name not in fixed}
        self.posed = {name: name.replace("world_to_camera", "pose") for name in fixed}  # what to seek in their place
        meshes = {"": start} if isinstance(start, Mesh) else {f"meshes.{i}.": m for i, m in enumerate(start.meshes)}
        self.movable = {f"{name}pose": mesh for name, mesh in meshes.items()}
        self.movable |= {f"cameras.{i}.pose": start for i in range(len(cameras))}


def builder(scene: object, cameras: list[Camera], drop_background: bool) -> tuple[Build, SceneTensors | None]:
    """Return a function from values to scene and cameras, and what may be sought; None if the scene is a function."""
    if isinstance(scene, Scene | Mesh):
        start = map_tensors(scene, lambda tensor: tensor.detach().cpu().clone())

        def replaced(values: Values) -> Built:
            poses = {name: value for name, value in values.items() if isinstance(value, Pose)}
            tensors = {name: value for name, value in values.items() if name not in poses}
            prefix = "cameras."
            inside = {name: value for name, value in tensors.items() if not name.startswith(prefix)}
            outside = {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
            there, seen = _moved(with_named(start, inside), list(with_named(cameras, outside)), poses)
            return whole_scene(there, drop_background), seen

        return replaced, SceneTensors(start, cameras)
    if not callable(scene):
        raise TypeError(f"scene: expected a Scene, a Mesh, or a function that makes one, got {type(scene).__name__}")

    def made(values: Values) -> Built:
        found = scene(values)
        whole, seen = found if isinstance(found, tuple) else (found, cameras)
        if not isinstance(whole, Scene | Mesh):
            raise TypeError(f"scene: expected a function that makes a Scene or a Mesh, got {type(whole).__name__}")
        seen = [seen] if isinstance(seen, Camera) else list(seen)
        if len(seen) != len(cameras):
            raise ValueError(f"scene: expected a function that makes {len(cameras)} cameras, got {len(seen)}")
        return whole_scene(whole, drop_background), seen

    return made, None


def whole_scene(made: Scene | Mesh, drop_background: bool) -> Scene:
    """Return a scene, or that of a mesh, which masks compare without its background."""
    scene = Scene([made]) if isinstance(made, Mesh) else made
    return scene.replace(background=None) if drop_background and scene.background is not None else scene


def _moved(scene: Scene | Mesh, cameras: list[Camera], poses: Mapping[str, Pose]) -> tuple[Scene | Mesh, list[Camera]]:
    """Move meshes and cameras by their poses."""
    for name, pose in poses.items():
        kind, _, rest = name.partition(".")
        place = int(rest.partition(".")[0]) if rest else 0
        if kind == "cameras":
            # A camera moved by M sees the world as the old one sees the world moved by M⁻¹.
            back = rigid(pose.R.mT, -(pose.R.mT @ pose.t))
            W = cameras[place].world_to_camera
            cameras[place] = cameras[place].replace(world_to_camera=(W.double() @ back.double()).to(W))
        elif isinstance(scene, Mesh):
            scene = scene.transformed(pose.R, pose.t, pose.scale)
        else:
            meshes = list(scene.meshes)
            meshes[place] = meshes[place].transformed(pose.R, pose.t, pose.scale)
            scene = scene.replace(meshes=meshes)
    return scene, cameras


def _unknown(what: str, name: str, names: Sequence[str]) -> ValueError:
    close = difflib.get_close_matches(name, names, n=1)
    suggestion = f"; did you mean {close[0]!r}?" if close else ""
    return ValueError(f"parameters: expected {what} among {', '.join(names)}, got {name!r}{suggestion}")


def checked_parameters(parameters: object, known: SceneTensors | None) -> dict[str, Parameter | Placement]:
    """Return each parameter with an initial value. Raises TypeError or ValueError."""
    if not isinstance(parameters, Mapping):
        raise TypeError(
            f"parameters: expected a mapping of names to learning rates or Parameters, got {type(parameters).__name__}; give "
            '{"meshes.0.verts": 0.01}, say'
        )
    if not parameters:
        raise ValueError("parameters: expected a name or more of what is sought, got none; nothing would change")
    found: dict[str, Parameter | Placement] = {}
    for name, given in parameters.items():
        if not isinstance(name, str):
            raise TypeError(
                f"parameters: expected names of what is sought as str, got {type(name).__name__} ({name!r})"
            )
        if known is not None and name in known.posed:
            pose = known.posed[name]
            raise ValueError(
                f"parameters: expected {pose!r} to move a camera, got {name!r}, whose numbers would not stay a rotation; give "
                f"{{{pose!r}: PoseParameter()}}"
            )
        if isinstance(given, PoseParameter):
            found[name] = _placement(name, given, known)
            continue
        if isinstance(given, bool) or not isinstance(given, (Parameter, int, float)):
            raise TypeError(
                f"{name}: expected a learning rate or a Parameter, got {type(given).__name__}; a value to start from is given by "
                "Parameter(lr, value)"
            )
        parameter = given if isinstance(given, Parameter) else Parameter(given)
        if known is not None:
            if name in known.movable:
                raise TypeError(f"{name}: expected a PoseParameter, got {type(given).__name__}; give PoseParameter()")
            if name not in known.tensors:
                raise _unknown("names", name, [*known.tensors, *known.movable])
            value = known.tensors[name]
            own = value if parameter.value is None else as_tensor(f"{name}: value", parameter.value, like=value)
            check_shape(name, own, tuple(value.shape), fix="the shape of the scene's tensor")
            parameter = replace(parameter, value=own)
        found[name] = parameter.checked(name)
    return found


def _placement(name: str, given: PoseParameter, known: SceneTensors | None) -> Placement:
    if known is None:
        return given.placed(name)
    if name not in known.movable:
        raise _unknown("a pose's name", name, list(known.movable))
    if name.startswith("cameras.") and given.scale is not None:
        raise ValueError(f"{name}: scale: expected None for a camera, got {given.scale!r}; leave it out")
    return given.placed(name, known.movable[name])


def build_detached(build: Build, values: Values) -> Built:
    """Build without gradients."""
    with torch.no_grad():
        built = build({name: map_tensors(value, Tensor.detach) for name, value in values.items()})
        return map_tensors(built, Tensor.detach)
