"""Robots from URDF files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..files.image import srgb_to_linear
from ..files.load import load_mesh
from ..files.parts import MESHES
from ..files.paths import PathLike, check_readable
from ..files.save import from_trimesh
from ..optional import require
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .control import Control
from .links import Links
from .rig import Rig

EXTRA = "edgegrad[robots]", "reading a robot"
MOVING = ("revolute", "continuous", "prismatic")


def load_robot(path: PathLike) -> Rig:
    """A Rig from a URDF file, whose control `angles` (m,) has the positions of its joints in the file's order: radians, or metres
    of prismatic ones. Joints that mimic others follow them and have none of their own.

        robot = eg.load_robot("arm.urdf")
        scene = robot.posed(angles=[0.0, 0.4, -1.2, 0.0, 0.7, 0.0, 0.0])

    One Mesh for each visual, from OBJ, glTF, GLB, PLY, STL, OFF, 3MF or DAE files, boxes, cylinders and spheres, in the colour of
    the visual's material where it has one. At rest all are 0, or at the limit nearest to 0. Limits are those of the file; fits
    keep them, robot.clamped(angles=…) applies them. Links are its joints, by their names.

    Files by yourdfpy, kinematics by pytorch-kinematics (`pip install 'edgegrad[robots]'`). Raises FileNotFoundError (the file, or
    a mesh that it names), ValueError that names the file (no URDF, no visuals, joints in a circle, a joint of another type),
    ImportError.
    """
    file = check_readable(path, (".urdf", ".xml"))
    yourdfpy, pk = require("yourdfpy", *EXTRA), require("pytorch_kinematics", *EXTRA)
    with _naming(file):
        given = yourdfpy.URDF.load(str(file), load_meshes=False, build_scene_graph=False)
    robot = given.robot
    joints = list(robot.joints)
    links = [link.name for link in robot.links]
    parents = _parents(file, links, joints)
    for joint in joints:
        if joint.type not in (*MOVING, "fixed"):
            raise ValueError(
                f"{file}: joint {joint.name!r}: expected a type among {', '.join(MOVING)} and fixed, got {joint.type!r}; "
                "replace it by joints of these"
            )
    meshes, carries = [], []
    for place, link in enumerate(robot.links):
        for visual in link.visuals:
            meshes.append(_mesh(file, link.name, visual, robot))
            carries.append(place)
    if not meshes:
        raise ValueError(f"{file}: expected links with visuals, got none; nothing of it is seen")
    with _naming(file):
        # As it was understood, for the other's parser refuses what is not of the format.
        chain = pk.build_chain_from_urdf(given.write_xml_string()).to(dtype=torch.float64)
    order = {name: k for k, name in enumerate(chain.get_joint_parameter_names())}
    free = [joint for joint in joints if joint.type in MOVING and joint.mimic is None]
    couple, offset = _coupling(file, [joint for joint in joints if joint.type in MOVING], free, order)
    low, high = (
        torch.tensor([_limit(joint, side) for joint in free], dtype=torch.float64) for side in ("lower", "upper")
    )
    if bool((low > high).any()):
        bad = free[int((low > high).nonzero()[0])].name
        raise ValueError(f"{file}: joint {bad!r}: expected limits with lower ≤ upper; repair them")
    rest = torch.zeros(len(free), dtype=torch.float64).clamp(low, high)
    control = Control(rest, low, high, tuple(joint.name for joint in free))
    deformer = Links(chain, tuple(carries), tuple(links), parents, couple, offset, {"angles": control})
    return Rig(meshes[0] if len(meshes) == 1 else Scene(meshes), deformer)


def _parents(file: Path, links: list[str], joints: list[Any]) -> tuple[int, ...]:
    """By link, the place of the one that it hangs on; −1 of none. Raises ValueError."""
    above: dict[str, str] = {}
    for joint in joints:
        for name in (joint.parent, joint.child):
            if name not in links:
                raise ValueError(f"{file}: joint {joint.name!r}: expected links of the file, got {name!r}; add it")
        if joint.child in above:
            raise ValueError(f"{file}: link {joint.child!r}: expected one joint above it, got two; a robot is a tree")
        above[joint.child] = joint.parent
    for link in links:
        seen, at = [link], link
        while at in above:
            at = above[at]
            if at in seen:
                raise ValueError(f"{file}: expected a tree of links, got a cycle: {' → '.join([*seen, at])}")
            seen.append(at)
    return tuple(links.index(above[link]) if link in above else -1 for link in links)


def _coupling(file: Path, moving: list[Any], free: list[Any], order: dict[str, int]) -> tuple[Tensor, Tensor]:
    """Of the chain's joints by the angles that are given: q = C a + c, where what mimics follows. Raises ValueError."""
    column = {joint.name: k for k, joint in enumerate(free)}
    couple, offset = (
        torch.zeros(len(order), len(free), dtype=torch.float64),
        torch.zeros(len(order), dtype=torch.float64),
    )
    by_name = {joint.name: joint for joint in moving}
    for joint in moving:
        factor, shift, at, seen = 1.0, 0.0, joint, [joint.name]
        while at.mimic is not None:
            own = 1.0 if at.mimic.multiplier is None else float(at.mimic.multiplier)
            shift += factor * float(at.mimic.offset or 0.0)
            factor *= own
            if at.mimic.joint not in by_name or at.mimic.joint in seen:
                raise ValueError(
                    f"{file}: joint {at.name!r}: expected a joint that moves to mimic, got {at.mimic.joint!r}"
                )
            at = by_name[at.mimic.joint]
            seen.append(at.name)
        couple[order[joint.name], column[at.name]] = factor
        offset[order[joint.name]] = shift
    return couple, offset


def _limit(joint: Any, side: str) -> float:
    value = None if joint.limit is None or joint.type == "continuous" else getattr(joint.limit, side)
    return (-np.inf if side == "lower" else np.inf) if value is None else float(value)


def _mesh(file: Path, link: str, visual: Any, robot: Any) -> Mesh:
    """In the link's coordinates. Raises FileNotFoundError or ValueError."""
    geometry = visual.geometry
    matrix = np.eye(4) if visual.origin is None else np.asarray(visual.origin, np.float64)
    if geometry.mesh is not None:
        mesh = _read(file, link, geometry.mesh.filename)
        scale = np.ones(3) if geometry.mesh.scale is None else np.broadcast_to(geometry.mesh.scale, 3)
        matrix = matrix @ np.diag([*scale, 1.0])
    else:
        creation = require("trimesh.creation", "trimesh", "shapes of robots")
        if geometry.box is not None:
            made = creation.box(geometry.box.size)
        elif geometry.cylinder is not None:
            made = creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=48)
        else:
            made = creation.icosphere(3, geometry.sphere.radius)
        mesh = Mesh(torch.tensor(made.vertices, dtype=torch.float32), torch.tensor(made.faces))
    placed = torch.tensor(matrix).to(mesh.verts)
    mesh = mesh.transformed(placed[:3, :3], placed[:3, 3])
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        mesh = mesh.replace(faces=mesh.faces.flip(1)) if mesh.uv_faces is None and mesh.normal_faces is None else mesh
    color = _color(visual.material, robot)
    if color is not None and mesh.channels is None:
        mesh = mesh.replace(face_colors=color.to(mesh.verts).repeat(len(mesh.faces), 1))
    elif color is None and mesh.channels is None:
        mesh = mesh.replace(face_colors=torch.full((len(mesh.faces), 3), 0.7, dtype=mesh.verts.dtype))
    return mesh.replace(name=f"{link}: {visual.name}" if visual.name else link)


def _read(file: Path, link: str, name: str) -> Mesh:
    handler = require("yourdfpy.urdf", *EXTRA).filename_handler_magic
    found = Path(handler(name, dir=str(file.absolute().parent)))
    found = found if found.is_absolute() else file.absolute().parent / found
    if not found.is_file():
        raise FileNotFoundError(
            f"{file}: link {link!r}: names the mesh {name!r}, and there is no such file in {file.absolute().parent} or above it; "
            "put it there"
        )
    if found.suffix.lower() in MESHES:
        try:
            return load_mesh(found)
        except ValueError as error:
            if "look alike" not in str(error) and "different textures" not in str(error):
                raise ValueError(f"{file}: link {link!r}: {error}") from error
            return load_mesh(found, materials=False)
    trimesh = require("trimesh", "trimesh", "reading meshes of robots")
    try:
        return from_trimesh(trimesh.load(found, force="mesh"))
    except ImportError:
        raise
    except Exception as error:
        raise ValueError(
            f"{file}: link {link!r}: expected a mesh in {name!r}, got one that cannot be read ({type(error).__name__}: {error}); "
            "convert it to GLB"
        ) from error


def _color(material: Any, robot: Any) -> Tensor | None:
    """(3,) linear, of rgba as displays show it."""
    if material is None:
        return None
    given = material.color
    if given is None:  # defined once for the whole robot
        given = next((m.color for m in robot.materials if m.name == material.name and m.color is not None), None)
    return None if given is None else srgb_to_linear(torch.tensor(given.rgba[:3], dtype=torch.float32))


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Whatever the libraries say of a file names it."""
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"{file}: expected a URDF, got one that cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
        ) from error
