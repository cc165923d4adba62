"""The nearest hits of any rays."""

from __future__ import annotations

import torch
from torch import Tensor

from ..check import as_tensor, check_finite, check_float, check_not_meta, check_shape
from ..kernel.derivatives import moves
from ..scene.mesh import Mesh
from ..scene.scene import Scene, as_scene
from .hits import Hits
from .records import barycentrics
from .records import trace as trace_records
from .surfaces import Rays, Surfaces


def trace(scene: Scene | Mesh, origins: Tensor, directions: Tensor) -> Hits:
    """Return the nearest hits of any rays: Hits of those that hit something, with the row of each in `hits.ray`.

    origins, directions  (N, 3) or (3,) world coordinates, directions of any length

    Positions, normals, texture coordinates and the rest are differentiable functions of the vertices, the origins and the
    directions, while each ray meets the same face: what moves at silhouettes has no gradient. `hits.depth` is in lengths of
    the direction; there is no `hits.pixel`. Raises TypeError or ValueError that names the argument.
    """
    scene = as_scene(scene)
    like = scene.meshes[0].verts
    given = {}
    for name, value in (("origins", origins), ("directions", directions)):
        tensor = as_tensor(name, value, like=like, floating=True)
        check_float(name, tensor)
        check_not_meta(name, tensor)
        check_shape(name, tensor, (len(tensor) if tensor.dim() == 2 and len(tensor) == 0 else "N", 3), (3,))
        check_finite(name, tensor, largest=1e30)
        given[name] = tensor.to(like.device, torch.float64)
    count = max(len(t) if t.dim() == 2 else 1 for t in given.values())
    for name, tensor in given.items():
        if tensor.dim() == 2 and len(tensor) not in (1, count):
            raise ValueError(f"{name}: expected as many rows as the other, {count}, got {len(tensor)}")
        given[name] = tensor.expand(count, 3)
    d = given["directions"]
    zero = (d.detach() == 0).all(1)
    if bool(zero.any()):
        raise ValueError(f"directions: expected lengths above zero, got zeros in row {int(zero.nonzero()[0])}")
    surfaces = Surfaces(scene)
    found = trace_records(surfaces.geometry, given["origins"], d)
    index = (found.face >= 0).nonzero()[:, 0]
    face, index = found.face[index].to(like.device), index.to(like.device)
    rays = Rays(index, given["origins"][index], d[index])
    b = barycentrics(found.b.to(like.device)[index])
    corners = surfaces.corners(face)
    if moves(corners, rays.origin, rays.direction):
        b = rays.barycentrics(corners.double(), b)
    return Hits(surfaces, rays, face, b)
