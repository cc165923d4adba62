"""Files that hypothesis draws, each with the arrays that it was written from."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class ExpectedMesh(NamedTuple):
    """A mesh of a file in its place: the values at the corners of F triangles, in float64."""

    corners: np.ndarray  # (F, 3, 3), in the world
    colors: np.ndarray | None = None  # (F, 3, 3), linear
    uvs: np.ndarray | None = None  # (F, 3, 2), v running up
    normals: np.ndarray | None = None  # (F, 3, 3), in the world, of any length
    name: str | None = None


class DrawnFile(NamedTuple):
    """A file, those that it names, and the meshes that it holds."""

    contents: dict[str, bytes]  # by name; the first is the file
    meshes: list[ExpectedMesh]


def placed(mesh: ExpectedMesh, matrix: np.ndarray) -> ExpectedMesh:
    """Return the mesh in a place. The front of a face stays its front in a mirror."""
    linear = matrix[:3, :3]
    side = -1 if np.linalg.det(linear) < 0 else 1
    corners = mesh.corners @ linear.T + matrix[:3, 3]
    normals = None if mesh.normals is None else mesh.normals @ np.linalg.inv(linear)
    moved = (corners, mesh.colors, mesh.uvs, normals)
    return ExpectedMesh(*(None if values is None else values[:, ::side] for values in moved))


def one_of(random: np.random.Generator, *values: Any) -> Any:
    """Return one by the generator: hypothesis, which likes to repeat itself, draws its seed, and the sizes, which shrink."""
    return values[int(random.integers(len(values)))]
