"""Small scenes and meshes that many tests share, in float64."""

from __future__ import annotations

import math

import numpy as np
import torch

from edgegrad.mesh import Mesh
from edgegrad.report.methods import default_samples
from edgegrad.report.scenes import (
    cube,
    front_camera,
    occluded_triangle,
    one_triangle,
    random_slivers,
    smooth_adjoint,
    smooth_colors,
    soup,
)

__all__ = [
    "cube",
    "default_samples",
    "front_camera",
    "icosphere",
    "occluded_triangle",
    "one_triangle",
    "random_slivers",
    "smooth_adjoint",
    "smooth_colors",
    "soup",
]


def icosphere(subdivisions: int = 3) -> Mesh:
    """Unit sphere of 20 · 4^subdivisions faces (3: 1,280; 6: 81,920), watertight, outward, with smooth colours."""
    phi = (1.0 + math.sqrt(5.0)) / 2.0
    # Corners (0, ±1, ±φ) and its rotations of coordinates: three rectangles, one in each plane.
    rectangle = np.array([[-1, phi, 0], [1, phi, 0], [-1, -phi, 0], [1, -phi, 0]])
    verts = np.concatenate([np.roll(rectangle, shift, axis=1) for shift in range(3)])
    # fmt: off
    faces = np.array([
        [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11],  # around corner 0
        [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],  # next to those
        [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9],  # around corner 3
        [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],  # next to those
    ])
    # fmt: on
    for _ in range(subdivisions):
        # Each edge is listed by both its faces; `middle` numbers the edges once, after the vertices.
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, first, middle = np.unique(edges[:, 0] * len(verts) + edges[:, 1], return_index=True, return_inverse=True)
        a, b, c = faces.T
        ab, bc, ca = (middle.reshape(-1, 3) + len(verts)).T
        verts = np.concatenate([verts, verts[edges[first]].mean(1)])
        faces = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], 1).reshape(-1, 3)
    verts_tensor = torch.from_numpy(verts / np.linalg.norm(verts, axis=1, keepdims=True))
    return Mesh(verts_tensor, torch.from_numpy(faces), colors=smooth_colors(verts_tensor))
