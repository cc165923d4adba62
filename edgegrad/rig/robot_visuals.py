"""The meshes of a robot's links, and their materials."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from os.path import isfile  # False also of names that no file can have
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..files.formats.context import UnreadLog
from ..files.image import read_image, srgb_to_linear
from ..files.load import load_parts
from ..files.paths import StoredPath
from ..optional import require
from ..scene.mesh import Mesh

DEFAULT_COLOR = 0.7  # of what has no colour


class Appearance(NamedTuple):
    """A material of a URDF."""

    color: Tensor | None  # (3,) linear
    texture: Tensor | None  # (h, w, 3) linear


class Visuals:
    """The visuals of a file, and a record of those that are not shown."""

    def __init__(self, file: Path, robot: Any, packages: Sequence[Path], unread: UnreadLog) -> None:
        self.file, self.robot, self.packages, self.unread = file, robot, packages, unread

    def meshes(self, link: str, visual: Any) -> list[Mesh]:
        """Return the meshes in the link's coordinates. Raises FileNotFoundError or ValueError."""
        geometry = visual.geometry
        matrix = np.eye(4) if visual.origin is None else np.asarray(visual.origin, np.float64)
        if geometry.mesh is not None:
            parts = self._read(link, geometry.mesh.filename)
            scale = (
                np.ones(1) if geometry.mesh.scale is None else np.asarray(geometry.mesh.scale, np.float64).reshape(-1)
            )
            if len(scale) not in (1, 3) or not np.isfinite(scale).all() or not scale.all():
                raise ValueError(
                    f"{self.file}: link {link!r}: expected a mesh scale of 3 finite numbers other than 0, got {scale.tolist()}; "
                    "repair it"
                )
            scale = np.broadcast_to(scale, 3)
            matrix = matrix @ np.diag([*scale, 1.0])
        else:
            parts = [_shape(geometry)]
        appearance = self._appearance(link, visual.material)
        name = f"{link}: {visual.name}" if visual.name else link
        found = []
        for k, part in enumerate(parts):
            placed = torch.tensor(matrix).to(part.verts)
            mesh = part.transformed(placed[:3, :3], placed[:3, 3])
            mesh = flipped(mesh) if np.linalg.det(matrix[:3, :3]) < 0.0 else mesh
            own = f"{name} {k}" if len(parts) > 1 else name
            found.append(self._painted(mesh, appearance, own).replace(name=own))
        return found

    def _painted(self, mesh: Mesh, appearance: Appearance, name: str) -> Mesh:
        """Return the mesh with the appearance of its file, or else with that of the URDF."""
        if mesh.channels is not None:
            return mesh
        if appearance.texture is not None and mesh.uvs is not None:
            return mesh.replace(texture=appearance.texture, uvs=mesh.uvs, uv_faces=mesh.uv_faces)
        if appearance.texture is not None:
            self.unread.note(f"the texture of {name!r}", "left out, for the shape has no texture coordinates")
        color = torch.full((3,), DEFAULT_COLOR) if appearance.color is None else appearance.color
        faces = color.to(mesh.verts).repeat(len(mesh.faces), 1)
        return mesh.replace(face_colors=faces, uvs=mesh.uvs, uv_faces=mesh.uv_faces)

    def _appearance(self, link: str, material: Any) -> Appearance:
        """Return the appearance of a material; its numbers are sRGB, as displays show them."""
        if material is None:
            return Appearance(None, None)
        shared = [one for one in self.robot.materials if one.name == material.name]  # defined once for the whole robot
        color, texture = (
            next((value for one in (material, *shared) if (value := getattr(one, name)) is not None), None)
            for name in ("color", "texture")
        )
        rgba = [] if color is None else [float(value) for value in color.rgba]
        if len(rgba) not in (0, 3, 4) or not np.isfinite(rgba).all():
            raise ValueError(
                f"{self.file}: link {link!r}: material {material.name!r}: expected rgba of 4 numbers from 0 to 1, got {rgba}; "
                "repair it"
            )
        if len(rgba) == 4 and rgba[3] < 1.0:
            self.unread.note(f"alpha {rgba[3]:g} of material {material.name!r}", "opaque")
        linear = srgb_to_linear(torch.tensor(rgba[:3], dtype=torch.float32)) if rgba else None
        return Appearance(linear, None if texture is None else self._texture(link, texture.filename))

    def _texture(self, link: str, name: str | None) -> Tensor | None:
        found = None if name is None else self._find(name)
        if found is None:
            self.unread.note(f"the texture {name!r} of link {link!r}", "left out, for there is no such file")
            return None
        try:
            return read_image(StoredPath(found), channels=3)
        except (ValueError, PermissionError) as error:
            self.unread.note(f"the texture {name!r} of link {link!r}", f"left out: {error}")
            return None

    def _read(self, link: str, name: str) -> list[Mesh]:
        found = self._find(name)
        if found is None:
            raise FileNotFoundError(
                f"{self.file}: link {link!r}: names the mesh {name!r}, and there is no such file in "
                f"{self.file.absolute().parent} or above it, nor in package_dirs; put it there, or pass the folder of its "
                "package by package_dirs="
            )
        try:
            return load_parts(found)
        except FileNotFoundError as error:
            self.unread.note(f"materials of {found.name}", f"left out: {error}")
            return load_parts(found, materials=False)
        except ValueError as error:
            raise ValueError(f"{self.file}: link {link!r}: {error}") from error

    def _find(self, name: str) -> Path | None:
        """Return a file by its path, or by a URL such as package://NAME/PATH: in the folders of packages, else in that of the
        robot's file and those above it."""
        scheme, _, rest = name.rpartition("://")
        package, _, within = rest.partition("/")
        here = self.file.absolute().parent
        for folder in (*(self.packages if scheme else ()), here, *here.parents):
            own = [folder / within] if scheme and folder.name == package else []
            if (found := next(filter(isfile, (folder / rest, *own)), None)) is not None:
                return found
        return None


def _shape(geometry: Any) -> Mesh:
    creation = require("trimesh.creation", "trimesh", "shapes of robots")
    if geometry.box is not None:
        made = creation.box(geometry.box.size)
    elif geometry.cylinder is not None:
        made = creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=48)
    else:
        made = creation.icosphere(3, geometry.sphere.radius)
    return Mesh(torch.tensor(made.vertices, dtype=torch.float32), torch.tensor(made.faces))


def flipped(mesh: Mesh) -> Mesh:
    """Return the mesh inside out: the corners of all faces in reverse order, with all that is indexed by corners, and normals
    negated. A mesh that was mirrored by `transformed` has its front outside again."""

    def reversed_rows(value: object, name: str) -> dict[str, object]:
        rows = getattr(value, name)
        return {} if rows is None else {name: rows.flip(1)}

    fields: dict[str, object] = {}
    for name in ("faces", "uv_faces", "normal_faces", "corner_colors"):
        fields |= reversed_rows(mesh, name)
    if mesh.normals is not None:
        fields["normals"] = -mesh.normals
    if mesh.material is not None:
        textures = {name: t.replace(**reversed_rows(t, "uv_faces")) for name, t in mesh.material.textures.items()}
        fields["material"] = mesh.material.replace(**textures)
    # dataclasses.replace, for mesh.replace() takes a kind of colour as one that is new.
    return dataclasses.replace(mesh, **fields)  # type: ignore[arg-type]
