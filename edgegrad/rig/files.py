"""Rigs from files, by their endings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import torch

from ..files.paths import PathLike
from .gltf import load_gltf
from .rig import Rig
from .urdf import load_urdf

ROBOTS = (".urdf", ".xml")


def load(
    path: PathLike,
    *,
    materials: bool = True,
    lit: bool = False,
    dtype: torch.dtype | None = None,
    package_dirs: PathLike | Sequence[PathLike] = (),
) -> Rig:
    """Return the rig of a glTF or GLB file, or the robot of a URDF file, by the name's ending.

    A glTF file gives what its skins, morph targets and nodes move, and its animations: its nodes are joints, and its rig has
    the controls `rotations`, `root` and `morphs`. A URDF file gives one control, `angles` (m,), with the positions of its
    joints in the file's order: radians, or metres of prismatic ones.

    Parameters
    ----------
    path : str or Path
        A file that ends in .gltf, .glb, .urdf or .xml.
    materials : bool, default True
        Whether colours and textures are read; of glTF files.
    lit : bool, default False
        Whether meshes are given their materials, and scenes their lights, as load_scene() does; of glTF files.
    dtype : torch.dtype, default as load_mesh() chooses it
        Floating-point type of the meshes; of glTF files.
    package_dirs : str, Path or a sequence of these
        Folders in which package://NAME/… is looked for as FOLDER/NAME/…, or as FOLDER/… where the folder itself is called NAME;
        of URDF files. By default, and then, the folder of the file and those above it are searched.

    Returns
    -------
    Rig
        `rig.posed(…)` is the mesh or the scene with its controls at the given values.

    Raises
    ------
    FileNotFoundError
        The file, or one that it names, is not there.
    ValueError
        The file cannot be read as a rig, or an argument is for files of the other kind.
    ImportError
        `pip install 'edgegrad[rigs]'` (glTF) or `'edgegrad[robots]'` (URDF) is missing.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path: expected a str or Path, got {type(path).__name__}")
    if Path(path).suffix.lower() not in ROBOTS:
        if package_dirs != ():
            raise ValueError("package_dirs: expected none with a glTF file, got some; they are for URDF files")
        return load_gltf(path, materials, lit, dtype)
    for name, changed in (
        ("materials", materials is not True),
        ("lit", lit is not False),
        ("dtype", dtype is not None),
    ):
        if changed:
            raise ValueError(f"{name}: expected the default with a URDF file, got another; it is for glTF files")
    return load_urdf(path, package_dirs)
