"""Scenes whose faces intersect, cut apart so that exact.py can integrate them.

Each face is cut by the planes of all faces that pass through it. The pieces meet along those planes and none passes through
another, and their corners are differentiable functions of the scene's vertices; so the exact gradient of the pieces' image is
that of the scene, lines of intersection included. Which faces pass through each other is decided here by exhaustion: a side of
one pierces the other.
"""

from __future__ import annotations

import torch
from torch import Tensor

from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from .exact import corner_colors

Corner = tuple[Tensor, Tensor]  # position and colour


def cut_apart(scene: Scene) -> Scene:
    """Return the same surfaces as a soup of triangles with colours of corners. Meshes must not have textures."""
    assert all(mesh.texture is None for mesh in scene.meshes), "cut_apart: meshes must not have textures"
    corners = torch.cat([mesh.verts.double()[mesh.faces.long()] for mesh in scene.meshes])
    colors = torch.cat([corner_colors(mesh, scene.channels) for mesh in scene.meshes])
    crossing = faces_that_cross(corners.detach())
    pieces = []
    for f in range(len(corners)):
        polygons = [list(zip(corners[f], colors[f], strict=True))]
        for g in torch.nonzero(crossing[f])[:, 0].tolist():
            polygons = [side for polygon in polygons for side in _cut(polygon, corners[g])]
        pieces += [corner for polygon in polygons for corner in _fan(polygon)]
    verts = torch.stack([position for position, _ in pieces])
    faces = torch.arange(len(verts)).reshape(-1, 3)
    soup = Mesh(verts, faces, corner_colors=torch.stack([color for _, color in pieces]).reshape(-1, 3, scene.channels))
    return scene.replace(meshes=[soup])


def faces_that_cross(corners: Tensor) -> Tensor:
    """Return (F, F), symmetric, whether a side of one of two triangles (F, 3, 3) pierces the other inside both."""
    a, b = corners, corners[:, [1, 2, 0]]  # the sides of each

    def volume(p: Tensor, q: Tensor, r: Tensor, s: Tensor) -> Tensor:
        return (torch.linalg.cross(q - p, r - p) * (s - p)).sum(-1)

    p, q = a[:, None, :], b[:, None, :]  # (F, 1, 3, 3): side i of f …
    x, y, z = (corners[None, :, i, None, :] for i in range(3))  # … and the triangle g
    size = (corners[:, 1:] - corners[:, :1]).norm(dim=-1).amax(1)
    # What is shared or touches is zero but for rounding.
    rounding = 1e-13 * (size[:, None] * size.clamp(min=1.0)[None] * size.amax())[..., None]
    from_plane, to_plane = volume(x, y, z, p), volume(x, y, z, q)
    splits = (from_plane * to_plane < 0) & (torch.minimum(from_plane.abs(), to_plane.abs()) > rounding)
    turns = torch.stack([volume(p, q, x, y), volume(p, q, y, z), volume(p, q, z, x)])
    pierces = (splits & ((turns > rounding).all(0) | (turns < -rounding).all(0))).any(-1)
    return pierces | pierces.T


def _cut(polygon: list[Corner], triangle: Tensor) -> list[list[Corner]]:
    """Return the parts of a polygon on both sides of the plane of a triangle."""
    normal = torch.linalg.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    distance = [normal @ (position - triangle[0]) for position, _ in polygon]
    sides = []
    for sign in (1.0, -1.0):
        side = []
        for k, (position, color) in enumerate(polygon):
            following, next_color = polygon[(k + 1) % len(polygon)]
            here, there = sign * distance[k], sign * distance[(k + 1) % len(polygon)]
            if here >= 0:
                side.append((position, color))
            if here * there < 0:
                t = here / (here - there)
                side.append((position + t * (following - position), color + t * (next_color - color)))
        if len(side) > 2:
            sides.append(side)
    return sides


def _fan(polygon: list[Corner]) -> list[Corner]:
    return [corner for k in range(2, len(polygon)) for corner in (polygon[0], polygon[k - 1], polygon[k])]
