"""What odd but valid files show, for tests/odd_gltf.py and tests/odd_3mf.py, which draw and write them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Shown(NamedTuple):
    """What a mesh looks like where it is placed: F triangles by the values at their corners, in float64."""

    corners: np.ndarray  # (F, 3, 3), in the world
    colors: np.ndarray | None  # (F, 3, 3), linear
    uvs: np.ndarray | None = None  # (F, 3, 2), v running up
    normals: np.ndarray | None = None  # (F, 3, 3), in the world, of length 1


class Odd(NamedTuple):
    """A file, those that it names, and what they show."""

    files: dict[str, bytes]  # the first is the file
    shown: list[Shown]


def placed(mesh: Shown, matrix: np.ndarray) -> Shown:
    """The front of a face stays its front in a mirror."""
    linear = matrix[:3, :3]
    side = -1 if np.linalg.det(linear) < 0 else 1
    corners = mesh.corners @ linear.T + matrix[:3, 3]
    normals = mesh.normals
    if normals is not None:
        normals = normals @ np.linalg.inv(linear)
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    shown = Shown(corners, mesh.colors, mesh.uvs, normals)
    return Shown(*(None if values is None else values[:, ::side] for values in shown))


def one_of(random: np.random.Generator, *values: Any) -> Any:
    """By the generator: hypothesis, which likes to repeat itself, draws its seed, and the sizes, which shrink."""
    return values[int(random.integers(len(values)))]
