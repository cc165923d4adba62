"""Robots from URDF files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..files.formats.context import UnreadLog
from ..files.paths import PathLike, check_readable
from ..optional import require
from ..scene.scene import Scene
from .control import Control
from .links import RobotLinks
from .rig import Rig
from .robot_visuals import Visuals

EXTRA = "edgegrad[robots]", "reading a robot"
MOVING = ("revolute", "continuous", "prismatic")


def load_urdf(path: PathLike, package_dirs: PathLike | Sequence[PathLike] = ()) -> Rig:
    """Return a Rig from a URDF file. Its control `angles` (m,) has the positions of its joints in the file's order: radians, or
    metres of prismatic ones.

        robot = eg.rig.load("arm.urdf")
        scene = robot.posed(angles=[0.0, 0.4, -1.2, 0.0, 0.7, 0.0, 0.0])

    Joints that mimic others follow them and have no angle. There is one Mesh for each visual, or for each part of it where
    parts differ in appearance: OBJ, glTF, GLB, PLY, STL, OFF, 3MF or DAE files (in the unit that a DAE says, along its own
    axes), boxes, cylinders and spheres. A mesh file's own appearance goes before the visual's material, whose colour or texture
    is shown else. One warning names what is not shown. At rest all angles are 0, or at the limit nearest to 0. Limits are those
    of the file, 0 where a <limit> lacks lower or upper; fits keep them, robot.clamped(angles=…) applies them. Links are the
    rig's joints, by their names.

    Files are read by yourdfpy, kinematics are by pytorch-kinematics (`pip install 'edgegrad[robots]'`). Raises
    FileNotFoundError (the file, or a mesh that it names), ValueError that names the file (no URDF, no visuals, no tree of
    links, a joint of another type or without an axis), ImportError.

    Parameters
    ----------
    path : str or Path
    package_dirs : str, Path or a sequence of these
        Folders in which package://NAME/… is looked for as FOLDER/NAME/…, or as FOLDER/… where the folder itself is called NAME.
        By default, and then, the folder of the file and those above it are searched.
    """
    file = check_readable(path, (".urdf", ".xml"))
    packages = _folders(package_dirs)
    yourdfpy, pk = require("yourdfpy", *EXTRA), require("pytorch_kinematics", *EXTRA)
    with _errors_with_path(file):
        given = yourdfpy.URDF.load(str(file), load_meshes=False, build_scene_graph=False)
    robot, unread = given.robot, UnreadLog()
    joints = list(robot.joints)
    links = [link.name for link in robot.links]
    parents = _parents(file, links, joints)
    for joint in joints:
        _check_joint(file, joint)
    visuals = Visuals(file, robot, packages, unread)
    meshes, carries = [], []
    for place, link in enumerate(robot.links):
        for visual in link.visuals:
            found = visuals.meshes(link.name, visual)
            meshes += found
            carries += [place] * len(found)
    if not meshes:
        raise ValueError(f"{file}: expected links with visuals, got none; nothing of it is seen")
    with _errors_with_path(file):
        # The other parser refuses content that is not of the format, so it gets what yourdfpy understood.
        chain = (pk.build_chain_from_urdf(given.write_xml_string()) if joints else _chain(pk, links[0])).to(
            dtype=torch.float64
        )
    order = {name: k for k, name in enumerate(chain.get_joint_parameter_names())}
    free = [joint for joint in joints if joint.type in MOVING and joint.mimic is None]
    couple, offset = _coupling(file, [joint for joint in joints if joint.type in MOVING], free, order)
    low, high = (
        torch.tensor([_limit(joint, side, unread) for joint in free], dtype=torch.float64)
        for side in ("lower", "upper")
    )
    if bool((low > high).any()):
        bad = free[int((low > high).nonzero()[0])].name
        raise ValueError(f"{file}: joint {bad!r}: expected limits with lower ≤ upper; repair them")
    rest = torch.zeros(len(free), dtype=torch.float64).clamp(low, high)
    control = Control(rest, low, high, tuple(joint.name for joint in free))
    deformer = RobotLinks(chain, tuple(carries), tuple(links), parents, couple, offset, {"angles": control})
    unread.warn(path)
    return Rig(meshes[0] if len(meshes) == 1 else Scene(meshes), deformer)


def _folders(given: PathLike | Sequence[PathLike]) -> list[Path]:
    several = [given] if isinstance(given, (str, os.PathLike)) else list(given)
    for folder in several:
        if not isinstance(folder, (str, os.PathLike)):
            raise TypeError(f"package_dirs: expected folders, got {type(folder).__name__}")
        if not Path(folder).is_dir():
            raise FileNotFoundError(
                f"package_dirs: expected folders, got {os.fspath(folder)!r}, where there is none; name others"
            )
    return [Path(folder).absolute() for folder in several]


def _check_joint(file: Path, joint: Any) -> None:
    if joint.type not in (*MOVING, "fixed"):
        raise ValueError(
            f"{file}: joint {joint.name!r}: expected a type among {', '.join(MOVING)} and fixed, got {joint.type!r}; "
            "replace it by joints of these"
        )
    axis = np.asarray(joint.axis, np.float64)
    if joint.type in MOVING and not (axis.shape == (3,) and 0.0 < np.linalg.norm(axis) < np.inf):
        raise ValueError(
            f"{file}: joint {joint.name!r}: expected an axis of 3 numbers that are not all 0, got {axis.tolist()}; repair it"
        )


def _chain(pk: Any, link: str) -> Any:
    """Return a chain of one link, which its builder does not make."""
    root = pk.frame.Frame(link)
    root.joint, root.link = pk.frame.Joint(), pk.frame.Link(link, pk.Transform3d(), [pk.frame.Visual()])
    return pk.Chain(root)


def _parents(file: Path, links: list[str], joints: list[Any]) -> tuple[int, ...]:
    """Return by link the place of its parent, −1 of none. Raises ValueError."""
    for what, names in (("link", links), ("joint", [joint.name for joint in joints])):
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice is not None:
            raise ValueError(f"{file}: {what} {twice!r}: expected each {what} once, got two of this name; rename one")
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
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        raise ValueError(
            f"{file}: expected one link that hangs on no other, got {len(roots)}: {', '.join(map(repr, roots[:5]))}; join them "
            "by fixed joints"
        )
    return tuple(links.index(above[link]) if link in above else -1 for link in links)


def _coupling(file: Path, moving: list[Any], free: list[Any], order: dict[str, int]) -> tuple[Tensor, Tensor]:
    """Return C and c of the chain's joints q = C a + c by the angles a that are given, where mimicking joints follow. Raises
    ValueError."""
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


def _limit(joint: Any, side: str, unread: UnreadLog) -> float:
    """Return the joint's limit: 0 where it does not say it, as the format defines it; infinite without a limit."""
    if joint.limit is None or joint.type == "continuous":
        return -np.inf if side == "lower" else np.inf
    value = getattr(joint.limit, side)
    if value is None:
        unread.note(
            f"limit of joint {joint.name!r} without {side}",
            "0, as the format says; a joint without limits is continuous",
        )
    return 0.0 if value is None else float(value)


@contextmanager
def _errors_with_path(file: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"{file}: expected a URDF, got one that cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
        ) from error
