"""The objects of a data set."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..files.formats.part import LoadOptions, errors_with_path
from ..files.load import load_mesh
from ..files.parts import read_mesh_file
from ..scene.mesh import Mesh
from ..scene.symmetries import Symmetries
from .json_files import numbers


class Model:
    """An object: its mesh in millimetres, its diameter and its symmetries.

    Attributes
    ----------
    obj_id, path : int, Path
        Its number, and its PLY file.
    diameter : float
        The largest distance between two vertices, mm.
    symmetries : Symmetries
    """

    def __init__(self, obj_id: int, path: Path, info: dict[str, Any], where: str) -> None:
        self.obj_id, self.path = obj_id, path
        self.diameter = float(numbers(where, info, "diameter"))
        try:
            self.symmetries = Symmetries.from_bop(info)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where}: {error}") from None

    @cached_property
    def mesh(self) -> Mesh:
        """Return the mesh with its colours or texture as radiance, read once. Raises what load_mesh raises."""
        return load_mesh(self.path)

    @cached_property
    def points(self) -> Tensor:
        """Return the vertices (N, 3) float64 in mm as the file has them, with repetitions, for means over them.

        Raises what load_mesh raises.
        """
        with errors_with_path(self.path):
            model = read_mesh_file(self.path, LoadOptions(materials=False))
        return torch.cat([torch.from_numpy(part.verts).double() for part in model.parts])

    def __repr__(self) -> str:
        return f"Model({self.obj_id}, diameter {self.diameter:.4g} mm, {self.symmetries!r})"
