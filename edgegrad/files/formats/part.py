"""The content of a mesh file before equal vertices are welded, and errors of its format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...scene.lights import Light
from ...scene.material import Material
from ..paths import PathLike


class FormatError(Exception):
    """An error of a file's content; the message does not name the file."""


class Part(NamedTuple):
    """A part of a file as it stands there; colours are linear."""

    name: str
    verts: np.ndarray  # (N, 3) float32, or float64 where the file says more; transformations applied
    faces: np.ndarray  # (F, 3) int64
    uvs: np.ndarray | None = None  # (N, 2) float32, v running up
    uv_faces: np.ndarray | None = None  # (F, 3) int64, indices into uvs; those of `faces` when None
    texture: Tensor | None = None  # (h, w, 3) float32
    colors: Tensor | None = None  # (N, 3) float32
    face_colors: Tensor | None = None  # (F, 3) float32
    alpha: Tensor | None = None  # (h, w) float32, of what is cut out
    cutoff: float = 0.5
    wrap: tuple[str, str] = ("repeat", "repeat")  # of u and v
    filter: str = "linear"
    normals: np.ndarray | None = None  # (N, 3) float32, of any length
    normal_faces: np.ndarray | None = None  # (F, 3) int64, indices into normals; those of `faces` when None
    material: Material | None = None  # one for all parts that the file gives it to; None: not lit
    material_uvs: Mapping[str, np.ndarray] = MappingProxyType({})  # (N, 2) of those of its textures that have their own

    def reversed(self) -> Part:
        """Return the part with the corners of all faces in reverse order, in every array of indices."""
        indices = {name: getattr(self, name) for name in ("faces", "uv_faces", "normal_faces")}
        return self._replace(**{n: np.ascontiguousarray(i[:, ::-1]) for n, i in indices.items() if i is not None})


class MeshFile(NamedTuple):
    """All parts and lights of a mesh file."""

    parts: list[Part]  # at least one, each with at least one triangle
    lights: list[Light]
    dtype: torch.dtype = torch.float32  # of the meshes


class LoadOptions(NamedTuple):
    materials: bool = True  # textures and material colours
    lit: bool = False  # materials that scatter light, normals and lights
    split: bool = False  # the objects of an OBJ file apart
    rigged: bool = False  # what moves the vertices of a glTF
    dtype: torch.dtype | None = None  # of the meshes; None: as precise as the file needs


@contextmanager
def errors_with_path(path: PathLike) -> Iterator[None]:
    """Turn FormatError and ValueError into a ValueError that names the file."""
    try:
        yield
    except FormatError as error:
        raise ValueError(f"{path}: {error}") from error.__cause__
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {error}") from error
